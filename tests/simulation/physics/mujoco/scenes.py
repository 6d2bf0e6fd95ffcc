"""The pokes that both engines do: their variations, and which of a pad's two kinds of tips MuJoCo uses."""

from collections.abc import Mapping
from dataclasses import dataclass, field

NODES = 6
SETTINGS = {  # of all pokes: what MuJoCo's world has not, and a block as hard as its beads
    "grasp__pre_tilt_spread_deg": 0.0,
    "grasp__pre_yaw_spread_deg": 0.0,
    "effects__gravity": "off",
    "effects__inertia": "off",
    "blocks__free": False,
    "blocks__stiffness_n_per_mm": 50000.0,
    "gel__node_rows": NODES,
    "gel__node_columns": NODES,
}


@dataclass(frozen=True)
class Poke:
    """One poke: scene, error, keys of the scene that are changed, how deep.

    apart: MuJoCo's tips press and shear apart, which is our law; else one sprung tip a node does both. agrees: the
    engines differ by no more than the sum of their refinement errors.
    """

    scene: str
    x_mm: float
    theta_deg: float
    changes: Mapping[str, float] = field(default_factory=dict)
    depth_mm: float = 1.0
    apart: bool = False
    agrees: bool = True

    @property
    def varied(self) -> str:
        """The changes in words."""
        words = [f"{key.replace('__', '.')} {value:g}" for key, value in self.changes.items()]
        if self.depth_mm != 1.0:
            words.append(f"{self.depth_mm:g} mm deep")
        return ", ".join(words) or "as it is"


SOFT = {"gel__thickness_mm": 4.0, "gel__shear_modulus_n_per_mm2": 0.05, "gel__crown_mm": 0.2}
HIGH = {"grasp__height_mm": 90.0, "grasp__force_n": 35.0, "blocks__friction": 0.05}

POKES = (
    Poke("rectangle", 8.0, 0.0, depth_mm=0.15),
    Poke("rectangle", 9.0, 0.0, HIGH, depth_mm=0.15),
    Poke("hexagon", 10.0, 0.0, depth_mm=0.15),
    Poke("hexagon", 6.0, 0.0, SOFT, depth_mm=0.15),
    Poke("white_box", 6.0, 0.0, {"blocks__friction": 0.6}, depth_mm=0.15),
    Poke("circle", 8.0, 0.0, depth_mm=0.15, apart=True),
    # so deep that the object tilts by 2 deg and more
    Poke("rectangle", 8.0, 0.0),
    Poke("rectangle", 9.0, 0.0, HIGH),
    Poke("hexagon", 10.0, 0.0),
    Poke("hexagon", 6.0, 0.0, SOFT),
    Poke("white_box", 12.0, 0.0, depth_mm=2.0, agrees=False),  # half of a pad slips, and MuJoCo's friction chatters
    Poke("rectangle", 2.0, 10.0, apart=True),
    Poke("rectangle", 8.0, 5.0, apart=True),
    Poke("circle", 8.0, 0.0, apart=True),
    Poke("can", 8.0, 5.0, apart=True),
    Poke("ellipse", 8.0, 0.0, apart=True),
    # friction holds a single tip on a slope; in our law pressure acts along the slope's normal and needs none
    Poke("circle", 8.0, 0.0, agrees=False),
    Poke("rectangle", 8.0, 5.0, agrees=False),
)
