"""What has to be shown before a descent may begin: that an object is held."""

from service.contract.wire import Arm
from service.perception.observation import PairObservation

LEAST_WIDTH_MM = 2.0  # fingers closer than this hold nothing but each other


def nothing_held(both: PairObservation) -> str:
    """Why the hand counts as empty, or nothing: both gels lie as they do where nothing touches them.

    One finger alone may look so: a flat object in a light grip hardly bulges it.
    """
    untouched = all(finger.bulge is not None and finger.bulge < 1.0 for finger in both.fingers)
    return "both gels look as they do when nothing touches them" if untouched else ""


def implausible_width(arm: Arm) -> str:
    """Why the gripper's width cannot be that of a held object, or nothing."""
    if arm.gripper_width_mm is None or arm.gripper_width_mm >= LEAST_WIDTH_MM:
        return ""
    return f"the fingers are {arm.gripper_width_mm:.1f} mm apart, a held object keeps them at least {LEAST_WIDTH_MM:g}"
