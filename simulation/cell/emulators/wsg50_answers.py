"""WSG-50 commands that only foreign drivers send, not this cell's own: this gripper has nothing to answer them with.

Cited by section: [M] WSG Command Set Reference Manual, firmware 4.0.0, July 2015.
"""

from robot_client.grippers.wsg50.codec import Frame
from robot_client.grippers.wsg50.codes import GraspingState, Status

OVERDRIVE, TARE, STATISTICS, TEMPERATURE, SET_TAG, GET_TAG = 0x37, 0x38, 0x42, 0x46, 0x51, 0x52
FINGERS = (0x60, 0x70)
MAX_TAG_BYTES = 64
# [M] 3.3.8, 3.3.9, 3.4.3, 3.4.7, 3.5.3
_PAYLOAD_BYTES = {OVERDRIVE: 1, TARE: 0, STATISTICS: 1, TEMPERATURE: 0, GET_TAG: 0}
# [M] 3.6.1 to 3.6.8: information, flags, power, data. Generic fingers: the tactile ones have their own cables
_FINGER_PAYLOAD_BYTES = {finger + place: size for finger in FINGERS for place, size in enumerate((0, 0, 1, 0))}


def foreign_status(frame: Frame, state: GraspingState) -> Status | None:
    """The status that answers such a command; None for a command that is answered elsewhere."""
    command, size = frame.command, len(frame.payload)
    if command == SET_TAG:  # [M] 3.5.2: NUL at the end is stripped
        return Status.OVERRUN if len(frame.payload.rstrip(b"\0")) > MAX_TAG_BYTES else Status.NOT_AVAILABLE
    if command in _FINGER_PAYLOAD_BYTES:
        return Status.NOT_AVAILABLE if size == _FINGER_PAYLOAD_BYTES[command] else Status.CMD_FORMAT_ERROR
    if command not in _PAYLOAD_BYTES:
        return None
    if size != _PAYLOAD_BYTES[command]:
        return Status.CMD_FORMAT_ERROR if _PAYLOAD_BYTES[command] else Status.NO_PARAM_EXPECTED
    # [M] 3.3.9: a tare is refused while it holds a part, and not available without a force-measuring finger
    return Status.ACCESS_DENIED if command == TARE and state is GraspingState.HOLDING else Status.NOT_AVAILABLE
