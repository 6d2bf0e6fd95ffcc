"""The page's texts, in plain words. Left, right and turns are those of the page's drawing, seen from above."""

from collections.abc import Callable
from typing import Any

from service.contract import wire
from service.contract.replies import MEANT
from service.contract.words.causes import what_of
from service.versions.versions import Rival, State

PHASES = {
    "start": "The robot is connected",
    "greeting": "The robot is connected",
    "learning": "Looking at the open gels",
    "grasping": "Closing the fingers",
    "approaching": "Moving above the gap",
    "arming": "Looking at the gels at rest",
    "armed": "Ready to go down",
    "descending": "Lowering the object into the gap",
    "stopping": "Felt an edge, stopping",
    "deciding": "Working out how far off it is",
    "retracting": "Going up again",
    "correcting": "Moving to the corrected place",
    "no_decision": "Cannot trust what was felt, so it probes again",
    "refused": "Not allowed to go down",
    "closing": "Down at full depth, checking that it is in",
}
CHANGES = {
    "shadow": "runs in shadow",
    "dropped": "runs in shadow no more",
    "promoted": "decides from the next insertion on",
    "rolled_back": "decides no more: the version before does, from the next insertion on",
}
CHARTS = {
    "light": "the brightness of the pictures",
    "markers": "how many of a gel's dots are seen",
    "gel": "how unlike a gel is to the one that was calibrated",
    "reach": "how far the gels are sheared at the stop",
    "coverage": "how many 90 % intervals hold",
    "trials": "how many attempts an object takes",
}
MAY_GO_ON = frozenset({"attempts", "no_decision", "refused"})
"""Causes after which a cycle may carry the part away and go on, so that who reads keeps clear."""
SHORT_N = 6  # of the letters of a version's name
TIMES = {1: "once", 2: "twice"}
SURE = ((0.9, "very sure of"), (0.7, "fairly sure of"), (0.45, "unsure of"), (0.0, "guessing"))


def sure(confidence: float) -> str:
    return next(word for least, word in SURE if confidence >= least) + " the direction"


def shift(dx_mm: float, dtheta_deg: float) -> str:
    """A motion or an error: "4.2 mm left, 3.1 deg clockwise" (positive x is right, positive yaw anticlockwise)."""
    parts = []
    if abs(dx_mm) >= 0.05:
        parts.append(f"{abs(dx_mm):.1f} mm {'right' if dx_mm > 0 else 'left'}")
    if abs(dtheta_deg) >= 0.05:
        parts.append(f"{abs(dtheta_deg):.1f}° {'anticlockwise' if dtheta_deg > 0 else 'clockwise'}")
    return ", ".join(parts) or "nothing"


def ended(outcome: str, cause: str | None, attempts_n: int, named: str = "", afresh_n: int = 0) -> str:
    """How an insertion ended; ``afresh_n``: how often the object was put back and regrasped."""
    if outcome == "inserted":
        what = named[:1].upper() + named[1:] if named else "Object"
        again = f", regrasped {TIMES.get(afresh_n, f'{afresh_n} times')}" if afresh_n else ""
        return f"{what} inserted after {attempts_n} attempt{'s' * (attempts_n != 1)}{again}"
    if outcome in MEANT.values():
        words = what_of(cause)
        return words[:1].upper() + words[1:]
    return f"{'Not inserted' if cause in MAY_GO_ON else 'Holding'}: {what_of(cause)}"


LINES: dict[type, Callable[[Any], str]] = {
    wire.ServiceHello: lambda _: "robot connected",
    wire.Enough: lambda m: f"pressed by {m.pressed_mm:.1f} mm, stopped",
    wire.Slip: lambda m: f"{m.finger} finger felt slip, stopped",
    wire.Correction: lambda m: f"moves {shift(m.dx_mm, m.dtheta_deg)}",
    wire.NoDecision: lambda m: f"no decision: {m.detail}",
    wire.Straighten: lambda m: f"straightens the object: tool tilted to {m.tilt_deg:+.1f}°",
    wire.Refused: lambda m: f"not started: {m.detail}",
    wire.Fault: lambda m: f"{m.code.replace('_', ' ')}: {m.detail}",
}


def event(message: Any, earlier_n: int = 0) -> str:
    """One line for the list of events; empty for those that do not concern a person.

    ``earlier_n``: attempts before the object was regrasped.
    """
    if isinstance(message, wire.Armed):
        return f"attempt {earlier_n + message.attempt} begins"
    if isinstance(message, wire.Finished):
        how = ended(message.outcome, message.cause, earlier_n + message.attempts).lower()
        return "; ".join([how, *(doubt.detail for doubt in message.doubts)])
    line = LINES.get(type(message))
    return line(message) if line else ""


def changed(version: dict[str, str]) -> str:
    return f"version {version['version'][:SHORT_N]} {CHANGES[version['what']]}: {version['why']}"


def versions(state: State) -> list[str]:
    """The version that decides, and those beside it with the evidence so far; empty without any."""
    beside = [("shadow", state.shadow), ("before", state.previous)]
    shown = [_rival(part, rival, state.enough) for part, rival in beside if rival is not None]
    return [f"version {state.active.version[:SHORT_N]} decides", *shown] if shown else []


def _rival(part: str, rival: Rival, enough: float) -> str:
    counted = f"{rival.evidence:.1f} of {enough:g} after {rival.ended_n}"
    return f"{part} {rival.version[:SHORT_N]}: {counted}"
