"""The text protocol of our RAPID modules on a controller without EGM: requests and answers end with ``#``.

Motion port: ``M id x y z q1 q2 q3 q4 speed#`` answered by ``D id#`` (done), ``S id#`` (stopped) or ``E id reason#``.
Guard port: ``H n#`` alive, ``R n#`` release, ``S n#`` stop, each answered by ``P n x y z q1 q2 q3 q4 stop#``.
Positions mm with 2 decimals, quaternion with 5, speed mm/s, of a turn deg/s: a RAPID string holds 80 characters.
"""

import math
from dataclasses import dataclass, field
from typing import Literal

from robot_client.insertion.geometry import Pose

MAX_TEXT = 80
MAX_NUMBER = 99_999
_MODULES = "TactileGuard.mod and TactileMotion.mod of this release"


class RapidTextError(ValueError):
    """Text outside this protocol, or a pose that must not be sent."""


@dataclass(frozen=True, slots=True)
class GuardState:
    """Answer of the guard: request number, measured pose, stop flag raised."""

    number: int
    pose: Pose
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
    match text.split():
        case ["P", number, x, y, z, qw, qx, qy, qz, "0" | "1" as stopped]:
            pose = Pose(*map(_number, (x, y, z, qw, qx, qy, qz))).check("guard pose")
            return GuardState(int(_number(number)), pose, stopped == "1")
    raise RapidTextError(f"the guard answered {text[:MAX_TEXT]!r}, expected P with nine fields: load {_MODULES}")


def decode_motion(text: str) -> MotionAnswer:
    """Read the motion server's answer (without ``#``); raises RapidTextError."""
    match text.split(maxsplit=2):
        case ["D", number]:
            return MotionAnswer(int(_number(number)), "done")
        case ["S", number]:
            return MotionAnswer(int(_number(number)), "stopped")
        case ["E", number, reason]:
            return MotionAnswer(int(_number(number)), "refused", reason)
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
