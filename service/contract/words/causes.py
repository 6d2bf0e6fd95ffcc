"""Why an insertion ended, and what an operator does about it."""

from typing import NamedTuple

from service.contract.wire_parts import Cause


class Told(NamedTuple):
    """What happened, as half a sentence, and the remedy as a whole one."""

    what: str
    remedy: str


CAUSES: dict[Cause, Told] = {
    "operator": Told("stopped by a person", "Start a new insertion when the cell is clear."),
    "probed": Told("a probe, done", "Nothing is to be done: go on with the next one."),
    "afresh": Told("it had turned in the hand and is taken afresh", "The arm does that by itself: keep clear."),
    "attempts": Told("all attempts used", "Look for a worn gel, a wrong gap width, or something in the gap."),
    "unwatched": Told("the pictures came too late", "Check the cameras' cables and the load of this PC."),
    "part_lost": Told("the object slipped out of the fingers", "Pick it up by hand. Check grip force and gel."),
    "not_confirmed": Told(
        "full depth, but not shown to be in", "Look before anything is released: the object may stand or jam."
    ),
    "no_decision": Told("what was felt cannot be trusted", "Check the gels and which camera is which."),
    "refused": Told(
        "the attempt was not allowed to start",
        "Check that the object hangs upright in the hand, and that both gels are seen.",
    ),
    "limits": Told(
        "a move beyond the limits was refused", "The start is wrong, or the work object is not where it should be."
    ),
    "arm": Told("a fault of the arm", "Look at the pendant: motors, protective stop, program."),
    "gripper": Told("a fault of the gripper", "Look at the gripper: power, cable, fast stop."),
    "camera": Told("a camera failed", "Check cable and power of that finger."),
    "service": Told("a fault of the service", "Read its log. It goes on by itself; start a new insertion."),
    "link": Told("robot and service lost each other", "Check the network; start a new insertion."),
    "timeout": Told("a step took too long", "Look at what the step waits for, and start a new insertion."),
    "client": Told("a fault of the robot client", "Keep its log, and start a new insertion."),
}


def what_of(cause: str | None) -> str:
    """A cause in words; one that this version does not know as it is."""
    if cause is None:
        return "no cause was recorded"
    told = CAUSES.get(cause)  # type: ignore[call-overload]
    return told.what if told else cause.replace("_", " ")
