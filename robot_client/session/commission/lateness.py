"""How late a cell's pictures and arm are together, from presses at two speeds in one grasp.

A press ends once the pictures show the gel pressed to a given depth. Pictures that are late show it as it was further
up, and an arm that is slow to stop goes on. Without the travel that the service knows of, the depth of the standstill
is a straight line in the speed, and its slope is the lateness of both. The object creeps up in the hand with each
press; two slow presses in a row show by how much.
"""

from collections.abc import Sequence

from robot_client.insertion.limits import LimitError
from robot_client.insertion.state import Plan
from robot_client.session.stops import Stop

PLACE = (8.0, 8.0)
"""Error of these presses, mm and deg: a corner of the object stands on one block."""
FAST = (False, False, True, False, False, True)
"""Which presses are fast. One slow press comes before them: after it the object sits, wherever it stopped."""
SLOW_MM_S, FAST_MM_S, LEAST_RATIO = 4.0, 10.0, 1.5
SLIDES_MM = 0.3  # an object that a slow press pushes up by more slides in the hand: one fast press must do


def slow_and_fast(plan: Plan, rate_hz: float) -> tuple[Plan, Plan]:
    """The slow and the fast press, each at one speed; raises LimitError where they are too close to each other.

    ``rate_hz``: frames a second of the cameras.
    """
    fast_mm_s = min(FAST_MM_S, plan.limits.max_descent_speed_mm_s, plan.lease.fastest_mm_s(rate_hz))
    if fast_mm_s < LEAST_RATIO * SLOW_MM_S:
        allowed = f"{fast_mm_s:.1f} mm/s, as limits and cameras of {rate_hz:.0f} frames a second allow"
        raise LimitError(f"presses at {SLOW_MM_S:g} and at {allowed}, do not tell how late pictures and arm are")
    press = plan.model_copy(update={"purpose": "timing", "pace": plan.pace.model_copy(update={"fast_mm_s": None})})
    return press.at_speed(SLOW_MM_S), press.at_speed(fast_mm_s)


def late_s(stops: Sequence[Stop]) -> float | None:
    """How late pictures and arm are together, s; None before the first fast press.

    Each fast press after two slow ones gives one value. The larger one counts.
    """
    estimates_s = []
    for index, (is_fast, _) in enumerate(zip(FAST, stops, strict=False)):
        if is_fast:
            settled, slow, fast = stops[index - 2 : index + 1]
            crept_mm = slow.touch_mm - settled.touch_mm
            later_mm = fast.touch_mm - slow.touch_mm - crept_mm
            estimates_s.append(later_mm / (fast.speed_mm_s - slow.speed_mm_s))
    return max(0.0, *estimates_s) if estimates_s else None


def goes_on(stops: Sequence[Stop]) -> bool:
    """Whether another press follows these: not after all, nor after a fast one if the object slides in the hand."""
    if len(stops) == len(FAST):
        return False
    slid_mm = abs(stops[-2].touch_mm - stops[-3].touch_mm) if stops and FAST[len(stops) - 1] else 0.0
    return slid_mm <= SLIDES_MM
