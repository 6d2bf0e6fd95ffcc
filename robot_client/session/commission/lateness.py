"""How late a cell's pictures and arm are together, from presses at two speeds.

A press ends once the pictures show the gel pressed to a given depth, or slip. Pictures that are late show it as it was
further up, and an arm that is slow to stop goes on. Without the travel that the service knows of, the depth of the
standstill is a straight line in the speed, and its slope is the lateness of both. The object creeps up in the hand with
each press; two slow presses show by how much.
"""

from collections.abc import Sequence

from robot_client.insertion.limits import LimitError
from robot_client.insertion.state import Plan
from robot_client.session.stops import Stop
from service.contract.frames import Contract

PLACE = (8.0, 8.0)
"""Error of these presses, mm and deg: a corner of the object stands on one block."""
FAST_MM_S, SLOWEST_MM_S, SLOW_SHARE, LEAST_RATIO = 10.0, 3.0, 0.4, 1.5
RATE_SHARE = 0.95  # a camera's rate that is measured again may be this much lower
FASTS_N, MOST_N = 2, 13
"""Fast presses that are needed, and presses at most, four of them fast: some tell nothing, their contact not known."""
STICKS, SLIDES = 0.5, 1.0
"""Part of the time between two frames by which a contact between them is uncertain: all of it if the object slides."""
LEAST_OPEN_S = 0.03
"""And by this at least: of fast cameras an estimate scatters by 9 ms (simulated), three times which is rare."""
SLIDES_MM = 0.3  # an object that a slow press pushes up by more slides: its motion does not grow in a straight line


class Press(Contract):
    """A press of the series; ``stop`` is None if it did not end because of what was pressed.

    ``afresh``: the first in a new grasp.
    """

    fast: bool
    stop: Stop | None = None  # the record's TOML leaves out what is None
    afresh: bool = False


def slow_and_fast(plan: Plan, rate_hz: float) -> tuple[Plan, Plan]:
    """The slow and the fast press, each at one speed; raises LimitError where they are too close to each other.

    ``rate_hz``: frames a second of the cameras.
    """
    fast_mm_s = min(FAST_MM_S, plan.limits.max_descent_speed_mm_s, plan.lease.fastest_mm_s(RATE_SHARE * rate_hz))
    slow_mm_s = max(SLOWEST_MM_S, SLOW_SHARE * fast_mm_s)
    if fast_mm_s < LEAST_RATIO * slow_mm_s:
        allowed = f"{fast_mm_s:.1f} mm/s, as limits and cameras of {rate_hz:.0f} frames a second allow"
        raise LimitError(f"presses at {slow_mm_s:g} and at {allowed}, do not tell how late pictures and arm are")
    press = plan.model_copy(update={"purpose": "timing", "pace": plan.pace.model_copy(update={"fast_mm_s": None})})
    return press.at_speed(slow_mm_s), press.at_speed(fast_mm_s)


def next_is_fast(series: Sequence[Press]) -> bool | None:
    """Whether the press after these is fast, which is so after two slow ones; None after the last one.

    The first press of each grasp is slow and not counted: after it the object sits, wherever it stopped.
    """
    estimates_s, slow = _read(series)
    if len(estimates_s) == FASTS_N or len(series) == MOST_N:
        return None
    return len(slow) >= 2


def late_s(series: Sequence[Press]) -> float | None:
    """How late pictures and arm are together at most, s; None before two fast presses, each after two slow ones.

    The larger estimate counts, as one alone may be short by a whole frame; and what the distance of two frames and the
    reading of a press leave open is added.
    """
    estimates_s, _ = _read(series)
    if len(estimates_s) < FASTS_N:
        return None
    slides = any(crept_mm > SLIDES_MM for _, crept_mm in estimates_s)
    frame_s = max(press.stop.frame_s for press in series if press.fast and press.stop)
    open_s = max(LEAST_OPEN_S, (SLIDES if slides else STICKS) * frame_s)
    return max(0.0, *(late for late, _ in estimates_s)) + open_s


def _read(series: Sequence[Press]) -> tuple[list[tuple[float, float]], list[tuple[int, Stop]]]:
    """Each estimate in s, with the creep of a press in mm; and the slow stops since the last fast press, numbered."""
    estimates_s: list[tuple[float, float]] = []
    slow: list[tuple[int, Stop]] = []
    for number, press in enumerate(series):
        if number == 0 or press.afresh:
            slow = []
        elif press.fast:
            if press.stop and len(slow) >= 2:
                (before_n, before), (last_n, last) = slow[-2:]
                crept_mm = (last.touch_mm - before.touch_mm) / (last_n - before_n)
                later_mm = press.stop.touch_mm - last.touch_mm - crept_mm * (number - last_n)
                estimates_s.append((later_mm / (press.stop.speed_mm_s - last.speed_mm_s), abs(crept_mm)))
            slow = []
        elif press.stop:
            slow.append((number, press.stop))
    return estimates_s, slow
