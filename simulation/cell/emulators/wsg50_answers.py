"""WSG-50 commands that only foreign drivers send, not this cell's own: answered with a value or "not available".

Cited by section: [M] WSG Command Set Reference Manual, firmware 4.0.0, July 2015.
"""

import struct
from collections.abc import Callable

from robot_client.grippers.wsg50.codec import Frame, encode_frame
from robot_client.grippers.wsg50.codes import GraspingState, Status
from simulation.cell.emulators.wsg50_gripper import Gripper

OVERDRIVE, TARE, STATISTICS, TEMPERATURE, SET_TAG, GET_TAG = 0x37, 0x38, 0x42, 0x46, 0x51, 0x52
INFO, FLAGS, POWER, DATA = range(4)  # of finger 1 from 0x60, of finger 2 from 0x70
FINGERS = (0x60, 0x70)
TENTHS_C = 365  # 36.5 degrees, in tenths
MAX_TAG_BYTES = 64
POWER_ON = 0x01
POWER_UP_S = 0.5

Answers = tuple[tuple[bytes, float], ...]
"""Replies in order, each with the delay before it is sent, in s."""


def answer(frame: Frame, gripper: Gripper) -> Answers | None:
    """The replies to such a command; None for a command that is answered elsewhere."""
    finger, command = frame.command & 0xF0, frame.command & 0x0F
    if finger in FINGERS and command <= DATA:
        return _finger(frame, command, finger == FINGERS[1], gripper)
    known = _ANSWERS.get(frame.command)
    return None if known is None else known(frame, gripper)


def _reply(frame: Frame, status: Status, values: bytes = b"") -> Answers:
    return ((_encoded(frame, status, values), 0.0),)


def _encoded(frame: Frame, status: Status, values: bytes = b"") -> bytes:
    return encode_frame(frame.command, struct.pack("<H", status) + (values if status is Status.SUCCESS else b""))


def _sized(frame: Frame, size: int) -> Status:
    """Whether the payload has this size, in the manual's words."""
    if len(frame.payload) == size:
        return Status.SUCCESS
    return Status.CMD_FORMAT_ERROR if size else Status.NO_PARAM_EXPECTED


def _finger(frame: Frame, command: int, second: bool, gripper: Gripper) -> Answers:
    """[M] 3.6.1 to 3.6.8. Both fingers are generic to the gripper: the tactile ones have their own cables."""
    if len(frame.payload) != (command == POWER):
        return _reply(frame, Status.CMD_FORMAT_ERROR)
    if command == DATA:
        return _reply(frame, Status.NOT_AVAILABLE)
    if command == INFO:
        return _reply(frame, Status.SUCCESS, struct.pack("<BH", 0, 0))
    if command == FLAGS:
        return _reply(frame, Status.SUCCESS, struct.pack("<H", POWER_ON * gripper.powered[second]))
    gripper.powered[second] = frame.payload != b"\0"
    if not gripper.powered[second]:
        return _reply(frame, Status.SUCCESS)
    return (_encoded(frame, Status.CMD_PENDING), 0.0), (_encoded(frame, Status.SUCCESS), POWER_UP_S)


def _overdrive(frame: Frame, gripper: Gripper) -> Answers:
    """[M] 3.3.8. The mode is reported (appendix B); this gripper's force limit stays the nominal force in it."""
    status = _sized(frame, 1)
    if status is Status.SUCCESS:
        gripper.overdrive = bool(frame.payload[0] & 1)
    return _reply(frame, status)


def _tare(frame: Frame, gripper: Gripper) -> Answers:
    """[M] 3.3.9: refused while it holds a part, and not available without a force-measuring finger."""
    status = _sized(frame, 0)
    if status is Status.SUCCESS:
        holding = gripper.state is GraspingState.HOLDING
        status = Status.ACCESS_DENIED if holding else Status.NOT_AVAILABLE
    return _reply(frame, status)


def _statistics(frame: Frame, gripper: Gripper) -> Answers:
    """[M] 3.4.3: u32 grips, u16 without a part, u16 lost parts; the lowest bit resets them after reading."""
    status = _sized(frame, 1)
    counted = struct.pack("<IHH", gripper.grasps_n, gripper.empty_n, gripper.lost_n)
    if status is Status.SUCCESS and frame.payload[0] & 1:
        gripper.grasps_n = gripper.empty_n = gripper.lost_n = 0
    return _reply(frame, status, counted)


def _temperature(frame: Frame, _gripper: Gripper) -> Answers:
    """[M] 3.4.7: tenths of a degree as i16."""
    return _reply(frame, _sized(frame, 0), struct.pack("<h", TENTHS_C))


def _get_tag(frame: Frame, gripper: Gripper) -> Answers:
    """[M] 3.5.3."""
    status = _sized(frame, 0)
    if status is Status.SUCCESS and not gripper.tag:
        status = Status.NOT_AVAILABLE
    return _reply(frame, status, gripper.tag)


def _set_tag(frame: Frame, gripper: Gripper) -> Answers:
    """[M] 3.5.2: at most 64 characters, no control characters; NUL at the end is stripped."""
    tag = frame.payload.rstrip(b"\0")
    if len(tag) > MAX_TAG_BYTES:
        return _reply(frame, Status.OVERRUN)
    if any(byte < 0x20 or byte > 0x7E for byte in tag):
        return _reply(frame, Status.INVALID_PARAMETER)
    gripper.tag = tag
    return _reply(frame, Status.SUCCESS)


_ANSWERS: dict[int, Callable[[Frame, Gripper], Answers]] = {
    OVERDRIVE: _overdrive,
    TARE: _tare,
    STATISTICS: _statistics,
    TEMPERATURE: _temperature,
    GET_TAG: _get_tag,
    SET_TAG: _set_tag,
}
