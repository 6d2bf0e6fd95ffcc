"""The text protocol of our RAPID modules on a controller without EGM: requests and answers end with ``#``.

Motion port: ``M id x y z q1 q2 q3 q4 speed#`` answered by ``D id#`` (done), ``S id#`` (stopped) or ``E id reason#``.
Guard port: ``H n#`` alive, ``R n#`` release, ``S n#`` stop, each answered by ``P n x y z q1 q2 q3 q4 moving stop#``.
Positions mm with 2 decimals, quaternion with 5, speed mm/s: a RAPID string holds 80 characters.
"""

import math
from dataclasses import dataclass, field
from typing import Literal

from robot_client.insertion.geometry import Pose

MAX_TEXT = 80
MAX_NUMBER = 99_999


class RapidTextError(ValueError):
    """Text outside this protocol, or a pose that must not be sent."""


@dataclass(frozen=True, slots=True)
class GuardState:
    """Answer of the guard: request number, measured pose, motion under way, stop flag raised."""

    number: int
    pose: Pose
    moving: bool
    stopped: bool


@dataclass(frozen=True, slots=True)
class MotionAnswer:
    """Answer of the motion server."""

    number: int
    result: Literal["done", "stopped", "refused"]
    reason: str = ""


def _pose_fields(pose: Pose) -> list[str]:
    pose.check("target pose")
    position = (pose.x_mm, pose.y_mm, pose.z_mm)
    return [f"{value:.2f}" for value in position] + [f"{value:.5f}" for value in pose.quaternion]


def encode_move(number: int, pose: Pose, speed_mm_s: float) -> bytes:
    """A move; raises ValueError for a bad pose, RapidTextError for a speed or a length out of bounds."""
    if not (math.isfinite(speed_mm_s) and 0.0 < speed_mm_s <= 999.0):
        raise RapidTextError(f"speed {speed_mm_s} mm/s, expected above 0 and at most 999")
    text = " ".join(["M", str(number), *_pose_fields(pose), f"{speed_mm_s:.1f}"]) + "#"
    if len(text) > MAX_TEXT:
        raise RapidTextError(f"{text!r} has {len(text)} characters, a RAPID string holds {MAX_TEXT}")
    return text.encode("ascii")


def encode_guard(kind: Literal["H", "R", "S"], number: int) -> bytes:
    """Alive, release or stop."""
    return f"{kind} {number}#".encode("ascii")


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise RapidTextError(f"{text!r} is no number") from None
    if not math.isfinite(value):
        raise RapidTextError(f"{text!r} is not finite")
    return value


def decode_guard(text: str) -> GuardState:
    """Read the guard's answer (without ``#``); raises ValueError."""
    fields = text.split()
    if len(fields) != 11 or fields[0] != "P" or not set(fields[9:]) <= {"0", "1"}:
        raise RapidTextError(f"the guard answered {text[:MAX_TEXT]!r}, expected P with ten fields")
    values = [_number(part) for part in fields[1:9]]
    pose = Pose(*values[1:4], *values[4:8]).check("guard pose")
    return GuardState(int(values[0]), pose, fields[9] == "1", fields[10] == "1")


def decode_motion(text: str) -> MotionAnswer:
    """Read the motion server's answer (without ``#``); raises RapidTextError."""
    fields = text.split(maxsplit=2)
    if len(fields) == 2 and fields[0] in ("D", "S"):
        return MotionAnswer(int(_number(fields[1])), "done" if fields[0] == "D" else "stopped")
    if len(fields) == 3 and fields[0] == "E":
        return MotionAnswer(int(_number(fields[1])), "refused", fields[2])
    raise RapidTextError(f"the motion server answered {text[:MAX_TEXT]!r}, expected D, S or E")


@dataclass(slots=True)
class TextParser:
    """Splits a TCP stream at ``#``; drops text longer than a RAPID string."""

    _rest: str = field(default="")

    def feed(self, data: bytes) -> list[str]:
        """Texts completed by ``data``, without their ``#``; bytes that are not ASCII become ``?``."""
        *whole, self._rest = (self._rest + data.decode("ascii", "replace")).split("#")
        if len(self._rest) > MAX_TEXT:
            self._rest = ""
        return [text for text in whole if len(text) <= MAX_TEXT]
