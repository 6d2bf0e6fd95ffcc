"""Changes of a scene that many tests make."""

UPRIGHT = {"grasp__pre_tilt_spread_deg": 0.0, "grasp__pre_yaw_spread_deg": 0.0}  # the object, in every grasp
