"""EGM datagrams, both directions: robot state (EgmRobot) and guidance (EgmSensor).

Positions mm, quaternion w, x, y, z (unit), joints deg, times ms of the sender's clock. Decoding refuses datagrams that
a controller or a guide must not act on: unparsable, oversized, non-finite, no unit quaternion.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, get_args

from google.protobuf.message import DecodeError, EncodeError

from robot_client.insertion.geometry import Pose
from robot_client.robots.abb_egm import tactile_insertion_egm_pb2 as pb

MAX_DATAGRAM_BYTES = 4096
SAME_TURN_DEG = 0.05  # between equivalent Euler angles and quaternion, rounded


class EgmError(ValueError):
    """An invalid datagram or target; the text gives the reason."""


McState = Literal["undefined", "error", "stopped", "running"]
_MC_VALUES = {
    "undefined": pb.EgmMCIState.MCI_UNDEFINED,
    "error": pb.EgmMCIState.MCI_ERROR,
    "stopped": pb.EgmMCIState.MCI_STOPPED,
    "running": pb.EgmMCIState.MCI_RUNNING,
}
_MC_STATES: tuple[McState, ...] = get_args(McState)


@dataclass(frozen=True, slots=True)
class RobotState:
    """One EgmRobot message. ``feedback`` is measured, ``planned`` the controller's present goal."""

    sequence: int
    time_ms: int
    feedback: Pose
    planned: Pose | None = None
    joints_deg: tuple[float, ...] = ()
    motors_on: bool = True
    rapid_running: bool = True
    mc_state: McState = "running"
    converged: bool = False
    collided: bool = False  # RobotWare 7: its motion supervision has triggered

    @property
    def unfit(self) -> str:
        """Why the robot does not follow targets, or ""."""
        if not self.motors_on:
            return "the motors are off"
        if not self.rapid_running:
            return "the RAPID program does not run"
        if self.mc_state != "running":
            return f"motion control reports EGM {self.mc_state}"
        return "motion supervision has seen a collision" if self.collided else ""

    @property
    def waits(self) -> bool:
        """Whether nothing but EGM itself does not run yet, which may do so only once a guide answers."""
        return self.motors_on and self.rapid_running and self.mc_state in ("undefined", "stopped")


@dataclass(frozen=True, slots=True)
class Guidance:
    """One EgmSensor message: a position target."""

    sequence: int
    time_ms: int = 0
    pose: Pose | None = None


def _check_finite(name: str, values: Iterable[float]) -> None:
    values = tuple(values)
    if not all(math.isfinite(value) for value in values):
        raise EgmError(f"{name} is {values}, expected finite numbers")


def _checked(name: str, pose: Pose) -> Pose:
    try:
        return pose.check(name)
    except ValueError as error:
        raise EgmError(str(error)) from None


def _put_pose(target: pb.EgmPose, pose: Pose) -> None:
    target.pos.x, target.pos.y, target.pos.z = pose.x_mm, pose.y_mm, pose.z_mm
    target.orient.u0, target.orient.u1, target.orient.u2, target.orient.u3 = pose.quaternion


def _euler_quaternion(x_deg: float, y_deg: float, z_deg: float) -> tuple[float, float, float, float]:
    """Quaternion of RAPID's ZYX Euler angles."""
    cx, cy, cz = (math.cos(math.radians(a) / 2) for a in (x_deg, y_deg, z_deg))
    sx, sy, sz = (math.sin(math.radians(a) / 2) for a in (x_deg, y_deg, z_deg))
    return (
        cx * cy * cz + sx * sy * sz,
        sx * cy * cz - cx * sy * sz,
        cx * sy * cz + sx * cy * sz,
        cx * cy * sz - sx * sy * cz,
    )


def _get_pose(source: pb.EgmPose, name: str) -> Pose:
    if not source.HasField("pos"):
        raise EgmError(f"{name} has no position")
    position = (source.pos.x, source.pos.y, source.pos.z)
    if not (source.HasField("orient") or source.HasField("euler")):
        raise EgmError(f"{name} has no orientation")
    quaternion = (source.orient.u0, source.orient.u1, source.orient.u2, source.orient.u3)
    if not source.HasField("euler"):
        return _checked(name, Pose(*position, *quaternion))
    angles = (source.euler.x, source.euler.y, source.euler.z)
    _check_finite(name, angles)
    pose = _checked(name, Pose(*position, *_euler_quaternion(*angles)))
    if source.HasField("orient"):
        apart_deg = _apart_deg(pose.quaternion, _checked(name, Pose(*position, *quaternion)).quaternion)
        if not apart_deg <= SAME_TURN_DEG:
            raise EgmError(f"{name} has Euler angles and a quaternion that differ by {apart_deg:.3f} deg")
    return pose


def _apart_deg(one: Iterable[float], other: Iterable[float]) -> float:
    """The angle between two orientations, deg; a quaternion and its negative are the same."""
    dot = abs(sum(a * b for a, b in zip(one, other, strict=True)))
    return math.degrees(2.0 * math.acos(min(1.0, dot)))


def encode_guidance(guidance: Guidance) -> bytes:
    """EgmSensor bytes (type CORRECTION); raises EgmError for non-finite values or no unit quaternion."""
    message = pb.EgmSensor()
    message.header.seqno = guidance.sequence & 0xFFFFFFFF
    message.header.tm = guidance.time_ms & 0xFFFFFFFF
    message.header.mtype = pb.EgmHeader.MSGTYPE_CORRECTION
    if guidance.pose is not None:
        _put_pose(message.planned.cartesian, _checked("target pose", guidance.pose))
    return bytes(message.SerializeToString())


def decode_guidance(datagram: bytes) -> Guidance:
    """Read EgmSensor bytes (the controller's side); raises EgmError."""
    message = pb.EgmSensor()
    _parse(message, datagram)
    has_pose = message.planned.cartesian.HasField("pos")
    pose = _get_pose(message.planned.cartesian, "target pose") if has_pose else None
    return Guidance(message.header.seqno, message.header.tm, pose)


def encode_robot(state: RobotState) -> bytes:
    """EgmRobot bytes (type DATA, the controller's side); raises EgmError for non-finite values."""
    message = pb.EgmRobot()
    message.header.seqno = state.sequence & 0xFFFFFFFF
    message.header.tm = state.time_ms & 0xFFFFFFFF
    message.header.mtype = pb.EgmHeader.MSGTYPE_DATA
    _check_finite("joints", state.joints_deg)
    for block, pose in ((message.feedBack, state.feedback), (message.planned, state.planned)):
        if pose is not None:
            _put_pose(block.cartesian, _checked("pose", pose))
            block.joints.joints.extend(state.joints_deg)
            block.time.sec, block.time.usec = state.time_ms // 1000, state.time_ms % 1000 * 1000
    message.motorState.state = pb.EgmMotorState.MOTORS_ON if state.motors_on else pb.EgmMotorState.MOTORS_OFF
    message.mciState.state = _MC_VALUES[state.mc_state]
    message.mciConvergenceMet = state.converged
    running = state.rapid_running
    message.rapidExecState.state = (
        pb.EgmRapidCtrlExecState.RAPID_RUNNING if running else pb.EgmRapidCtrlExecState.RAPID_STOPPED
    )
    message.utilizationRate = 0.0
    if state.collided:
        message.CollisionInfo.collsionTriggered = True
    return bytes(message.SerializeToString())


def decode_robot(datagram: bytes) -> RobotState:
    """Read EgmRobot bytes; raises EgmError. Absent states count as off, stopped or undefined.

    Controllers have been reported that call RAPID undefined, however it runs, from a restart on (abb_libegm, pull
    request 96): there the state of the motion control must do.
    """
    message = pb.EgmRobot()
    _parse(message, datagram)
    joints = tuple(message.feedBack.joints.joints)
    _check_finite("joints", joints)
    has_planned = message.planned.cartesian.HasField("pos")
    return RobotState(
        sequence=message.header.seqno,
        time_ms=message.header.tm,
        feedback=_get_pose(message.feedBack.cartesian, "feedback pose"),
        planned=_get_pose(message.planned.cartesian, "planned pose") if has_planned else None,
        joints_deg=joints,
        motors_on=message.motorState.state == pb.EgmMotorState.MOTORS_ON,
        rapid_running=message.HasField("rapidExecState")
        and message.rapidExecState.state != pb.EgmRapidCtrlExecState.RAPID_STOPPED,
        mc_state=_MC_STATES[message.mciState.state],
        converged=message.mciConvergenceMet,
        collided=message.CollisionInfo.collsionTriggered,
    )


def _parse(message: pb.EgmRobot | pb.EgmSensor, datagram: bytes) -> None:
    if len(datagram) > MAX_DATAGRAM_BYTES:
        raise EgmError(f"datagram of {len(datagram)} bytes, expected at most {MAX_DATAGRAM_BYTES}")
    try:
        message.ParseFromString(datagram)
    except (DecodeError, EncodeError) as error:
        raise EgmError(
            f"datagram of {len(datagram)} bytes does not parse as {type(message).__name__}: {error}"
        ) from None
    if not message.HasField("header"):
        raise EgmError(f"{type(message).__name__} has no header")
