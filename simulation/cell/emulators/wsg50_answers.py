"""Commands of the WSG-50 that this cell's own driver never sends, and foreign drivers do: a value or "not available".

Ids and layouts are those of the libraries that agree on them: [J] ThomasKuehne/wsg50 (Java), [D]
RobotLocomotion/drake-schunk-driver, [K] the command list of the Kawasaki emulator, [N] nalt/wsg50-ros-pkg.
"""

import struct
from collections.abc import Callable

from robot_client.grippers.wsg50.codec import Frame, encode_frame
from robot_client.grippers.wsg50.codes import Status
from simulation.cell.emulators.wsg50_gripper import Gripper

OVERDRIVE, TARE, STATISTICS, TEMPERATURE, GET_TAG, SET_TAG = 0x37, 0x38, 0x42, 0x46, 0x51, 0x52
FINGERS = range(0x60, 0x64)  # [J], [D]: index byte first
TENTHS_C = 365  # 36.5 degrees, in tenths
MAX_TAG_BYTES = 64


def answer(frame: Frame, gripper: Gripper) -> bytes | None:
    """The whole reply to such a command, None for one that is answered elsewhere."""
    if frame.command in FINGERS:
        return _fingers(frame)
    known = _ANSWERS.get(frame.command)
    return None if known is None else known(frame, gripper)


def _reply(frame: Frame, status: Status, values: bytes = b"") -> bytes:
    return encode_frame(frame.command, struct.pack("<H", status) + values)


def _sized(frame: Frame, *sizes: int) -> Status:
    """Whether the payload has one of these sizes, in the protocol's own words."""
    size = len(frame.payload)
    if size in sizes:
        return Status.SUCCESS
    if not max(sizes):
        return Status.NO_PARAM_EXPECTED
    return Status.NOT_ENOUGH_PARAMS if size < min(sizes) else Status.CMD_FORMAT_ERROR


def _fingers(frame: Frame) -> bytes:
    """These fingers are plain metal to the gripper: the tactile ones have cables of their own."""
    status = _sized(frame, 1, 2)
    if status is Status.SUCCESS:
        status = Status.NOT_AVAILABLE if frame.payload[0] < 2 else Status.INDEX_OUT_OF_BOUNDS
    return _reply(frame, status)


def _overdrive(frame: Frame, _gripper: Gripper) -> bytes:
    """[J]; gone from newer firmware ([D] has it no more)."""
    status = _sized(frame, 1)
    return _reply(frame, Status.NOT_AVAILABLE if status is Status.SUCCESS else status)


def _tare(frame: Frame, _gripper: Gripper) -> bytes:
    """[N] issue 5, [D]: not available without a force-measuring finger."""
    status = _sized(frame, 0)
    return _reply(frame, Status.NOT_AVAILABLE if status is Status.SUCCESS else status)


def _statistics(frame: Frame, gripper: Gripper) -> bytes:
    """[J]: u32 grasps, u16 without a part, u16 lost parts; the lowest bit of the request sets them back."""
    status = _sized(frame, 1)
    if status is not Status.SUCCESS:
        return _reply(frame, status)
    counted = struct.pack("<IHH", gripper.grasps_n, gripper.empty_n, gripper.lost_n)
    if frame.payload[0] & 1:
        gripper.grasps_n = gripper.empty_n = gripper.lost_n = 0
    return _reply(frame, status, counted)


def _temperature(frame: Frame, _gripper: Gripper) -> bytes:
    """Tenths of a degree as i16; asked with nothing ([J]) or like the other states."""
    status = _sized(frame, 0, 3)
    return _reply(frame, status, struct.pack("<h", TENTHS_C) if status is Status.SUCCESS else b"")


def _get_tag(frame: Frame, gripper: Gripper) -> bytes:
    """[J]."""
    status = _sized(frame, 0)
    return _reply(frame, status, gripper.tag if status is Status.SUCCESS else b"")


def _set_tag(frame: Frame, gripper: Gripper) -> bytes:
    """[J]; a tag that is too long is refused."""
    if len(frame.payload) > MAX_TAG_BYTES:
        return _reply(frame, Status.RANGE_ERROR)
    gripper.tag = frame.payload
    return _reply(frame, Status.SUCCESS)


_ANSWERS: dict[int, Callable[[Frame, Gripper], bytes]] = {
    OVERDRIVE: _overdrive,
    TARE: _tare,
    STATISTICS: _statistics,
    TEMPERATURE: _temperature,
    GET_TAG: _get_tag,
    SET_TAG: _set_tag,
}
