"""Settings and result of one finger's slip detector."""

from dataclasses import dataclass
from typing import Literal

from service.perception.markers.field import BoolArray, FloatArray

FingerState = Literal[
    "no_contact", "grasping", "hold", "contact", "incipient_slip", "gross_slip", "release", "lost", "unknown"
]


@dataclass(frozen=True, slots=True)
class SlipSettings:
    """Limits in shares of the marker pitch, so that they hold at every resolution; times in seconds.

    Slip is declared when ``slip_share`` of the nodes known to have stuck (at least ``min_nodes``) lag the object by
    more than ``slip_pitch`` beyond their elastic share, and by ``stand_out`` times the lag of the better half of them
    (their median, averaged over ``noise_s``). In an object that cannot be followed rigidly, because it is soft, shaken
    or blurred, no node therefore stands out. The elastic share is learned while the object has moved less than
    ``learn_pitch``, and later from nodes whose lag grows by less than ``learn_share`` of the motion.

    ``max_shift_pitch`` and ``max_angle_deg`` are the safety rule: a patch carried further than this must stop the arm
    even if no node has slipped.

    A patch that slides straight leaves no node behind: its motion, which followed the fingers, stops. That is slip if
    within ``stall_s`` it moves on by less than ``stall_share`` of its fastest such stretch and was carried by
    ``stall_pitch``, about half of the friction that a grasp can bear. This applies while the arm descends.
    """

    slip_pitch: float = 0.10
    slip_share: float = 0.25
    min_nodes: int = 3
    stand_out: float = 7.0
    noise_s: float = 0.2
    learn_pitch: float = 0.2
    learn_share: float = 0.05
    gross_share: float = 0.6
    tolerance_pitch: float = 0.03
    still_pitch: float = 0.02
    contact_pitch: float = 0.06
    follow_share: float = 0.35
    max_scale_change: float = 0.08
    release_scale: float = 0.03
    max_shift_pitch: float = 2.0
    max_angle_deg: float = 15.0
    lost_after_s: float = 0.2
    stall_s: float = 0.045
    stall_share: float = 0.15
    stall_pitch: float = 0.5


@dataclass(frozen=True, slots=True)
class SlipState:
    """The present state of one finger.

    ``score`` is the slip evidence, slip at 1 and above. ``residual_px`` float32 [rows, cols, 2] is each marker's
    deviation from the object's motion, ``slipping`` and ``sticking`` [rows, cols] the nodes of each class. The object's
    motion since the reference is ``shift_px`` (of the patch's centre, u right, v down) and ``angle_rad`` (from u to v).
    ``over_limit`` is the safety rule; ``stop``: the arm must stop.
    """

    state: FingerState
    score: float
    residual_px: FloatArray
    slipping: BoolArray
    sticking: BoolArray
    shift_px: tuple[float, float]
    angle_rad: float
    scale: float
    over_limit: bool
    captured_ns: int
    reason: str

    @property
    def slip(self) -> bool:
        """True on incipient or gross slip."""
        return self.state in {"incipient_slip", "gross_slip"}

    @property
    def stop(self) -> bool:
        """True on slip, on too large a motion of the patch, and where contact or sight is lost."""
        return self.slip or self.over_limit or self.state in {"release", "lost"}
