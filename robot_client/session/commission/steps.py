"""What is left of a commissioning, in words, before anything of it moves."""

from collections.abc import Sequence
from pathlib import Path

from robot_client.session.commission.lateness import MOST_N, PLACE
from robot_client.session.commission.record import Record
from robot_client.session.commission.run import PER_GRASP, PRESSES, REACH
from robot_client.session.commission.taught import CELL
from robot_client.session.commission.wiring import SIDES

CHANGED = "if tool, frame or camera mount has changed, move its folder away and commission again"


def steps_of(probes_n: int, path: Path, record: Record | None, grips_n: Sequence[float | None]) -> list[str]:
    """What comes, with the record that it goes on with; a complete one is not probed again."""
    left = left_of(record, probes_n, grips_n)
    if record and not left:
        return [f"probe nothing: the record of {record.begun} in {path} is complete; {CHANGED}"]
    return [
        *([f"go on with the record of {record.begun}; {CHANGED}"] if record else []),
        f"regrasp the object from its fixture: before each probe, and before every {PER_GRASP} of the last ones",
        *left,
        f"keep what was seen in {path} after each, with pictures of the signs and presses, and {CELL} beside it",
    ]


def left_of(record: Record | None, probes_n: int, grips_n: Sequence[float | None]) -> list[str]:
    """The probes and presses that the record lacks; empty if it is complete."""
    record = record or Record(begun="", seed=0)
    signs, steps = SIDES[len(record.signs) :], list[str]()
    if signs:
        steps.append(f"probe at {_places(signs)}: are the signs right?")
    if record.late_s is None:
        steps.append(f"press 7 to {MOST_N} times at {_places((PLACE,))}, at two speeds: how late are pictures and arm?")
    pressed_n = len(record.presses)
    for number, grip_n in enumerate(grips_n):
        if presses := PRESSES[max(0, pressed_n - number * len(PRESSES)) :]:
            at = f", at {grip_n:g} N" if grip_n else ""
            steps.append(f"press at {_places(presses)} until the gel slides{at}")
    presses_n = max(0, len(PRESSES) * len(grips_n) - pressed_n)
    if (more_n := probes_n - record.done_n - len(signs) - presses_n) > 0:
        steps.append(f"{more_n} more probes from errors within {REACH[0]:g} mm and {REACH[1]:g} deg")
    return steps


def _places(of: Sequence[tuple[float, float]]) -> str:
    return ", ".join(f"{x:+g} mm {theta:+g} deg" for x, theta in of)
