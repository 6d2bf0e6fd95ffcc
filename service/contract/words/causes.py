"""Why an insertion ended, and the operator's remedy."""

from typing import NamedTuple

from service.contract.wire_parts import Cause


class Ending(NamedTuple):
    """What happened, as half a sentence, and the remedy as a whole one."""

    what: str
    remedy: str


CAUSES: dict[Cause, Ending] = {
    "operator": Ending("stopped by a person", "Start a new insertion when the cell is clear."),
    "probed": Ending("a probe, done", "Nothing is to be done: go on with the next one."),
    "afresh": Ending("it had turned in the hand and is regrasped", "The arm does that by itself: keep clear."),
    "attempts": Ending("all attempts used", "Look for a worn gel, a wrong gap width, or something in the gap."),
    "unwatched": Ending("the pictures came too late", "Check the cameras' cables and the load of this PC."),
    "part_lost": Ending("the object slipped out of the fingers", "Pick it up by hand. Check grip force and gel."),
    "not_confirmed": Ending(
        "full depth, but not shown to be in", "Look before anything is released: the object may stand or jam."
    ),
    "no_decision": Ending("what was felt cannot be trusted", "Check the gels and which camera is which."),
    "refused": Ending(
        "the attempt was not allowed to start",
        "Check that the object hangs upright in the hand, and that both gels are seen.",
    ),
    "limits": Ending(
        "a move beyond the limits was refused", "The start is wrong, or the work object is not where it should be."
    ),
    "arm": Ending("a fault of the arm", "Look at the pendant: motors, protective stop, program."),
    "gripper": Ending("a fault of the gripper", "Look at the gripper: power, cable, fast stop."),
    "camera": Ending("a camera failed", "Check cable and power of that finger."),
    "service": Ending("a fault of the service", "Read its log. It goes on by itself; start a new insertion."),
    "link": Ending("robot and service lost each other", "Check the network; start a new insertion."),
    "timeout": Ending("a step took too long", "Look at what the step waits for, and start a new insertion."),
    "client": Ending("a fault of the robot client", "Keep its log, and start a new insertion."),
}


def what_of(cause: str | None) -> str:
    """A cause in words; one unknown to this version is returned unchanged."""
    if cause is None:
        return "no cause was recorded"
    known = CAUSES.get(cause)  # type: ignore[call-overload]
    return known.what if known else cause.replace("_", " ")
