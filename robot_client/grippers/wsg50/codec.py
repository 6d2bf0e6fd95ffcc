"""The WSG-50's binary protocol, both directions, as pure functions of bytes.

Request: ``AA AA AA | id u8 | length u16 | payload | crc u16``; a reply's payload begins with a status u16 and carries
parameters only if that status is SUCCESS. Everything is little-endian. Two-stage commands answer CMD_PENDING first and
send a second reply with the same id when done. Widths in mm, speeds in mm/s, forces in N, periods in ms.
"""

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field

from robot_client.grippers.wsg50.codes import Command, MoveFlag, Status

PREAMBLE = b"\xaa\xaa\xaa"
MAX_PAYLOAD_BYTES = 1024
ACKNOWLEDGE_WORD = b"ack"
_HEADER = struct.Struct("<3sBH")
_TRAILER = struct.Struct("<H")


class WsgError(ValueError):
    """Bytes or values outside the protocol; ``status`` is the gripper's answer to them."""

    def __init__(self, text: str, status: Status = Status.CMD_FORMAT_ERROR) -> None:
        super().__init__(text)
        self.status = status


_NONE, _FLOAT, _TWO_FLOATS, _QUERY = "<", "<f", "<ff", "<BH"
_REQUESTS = {
    _NONE: "DISCONNECT STOP FAST_STOP GET_ACCELERATION GET_FORCE_LIMIT GET_SOFT_LIMITS CLEAR_SOFT_LIMITS"
    " SYSTEM_INFO SYSTEM_LIMITS",
    _FLOAT: "SET_ACCELERATION SET_FORCE_LIMIT",
    _TWO_FLOATS: "GRASP RELEASE SET_SOFT_LIMITS",
    _QUERY: "SYSTEM_STATE GRASPING_STATE WIDTH SPEED FORCE",
    "<B": "HOMING",
    "<Bff": "MOVE",
    "<3s": "ACKNOWLEDGE",
}
_REPLIES = {
    _FLOAT: "GET_ACCELERATION GET_FORCE_LIMIT WIDTH SPEED FORCE",
    _TWO_FLOATS: "GET_SOFT_LIMITS",
    "<I": "SYSTEM_STATE",
    "<B": "GRASPING_STATE",
    "<BBHI": "SYSTEM_INFO",
    "<8f": "SYSTEM_LIMITS",
}
_REQUEST, _REPLY = (
    {Command[name]: layout for layout, names in table.items() for name in names.split()}
    for table in (_REQUESTS, _REPLIES)
)
STATE_QUERIES = frozenset(command for command, layout in _REQUEST.items() if layout == _QUERY)

Value = int | float | bytes


def _table() -> tuple[int, ...]:
    rows = []
    for index in range(256):
        value = index << 8
        for _ in range(8):
            value = (value << 1) ^ (0x1021 if value & 0x8000 else 0)
        rows.append(value & 0xFFFF)
    return tuple(rows)


_CRC_TABLE = _table()


def crc16(data: bytes) -> int:
    """CRC of the whole frame before the CRC bytes: an MSB-first table of 0x1021 used with an LSB-style update."""
    value = 0xFFFF
    for byte in data:
        value = _CRC_TABLE[(value ^ byte) & 0xFF] ^ (value >> 8)
    return value


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame with a correct CRC: command id (any u8) and payload."""

    command: int
    payload: bytes = b""


@dataclass(frozen=True, slots=True)
class Request:
    """A decoded request: its fields in wire order (ACKNOWLEDGE and LOOP have one ``bytes`` field)."""

    command: Command
    values: tuple[Value, ...] = ()


@dataclass(frozen=True, slots=True)
class Reply:
    """A decoded reply or auto-update; ``values`` is empty unless ``status`` is SUCCESS."""

    command: int
    status: Status
    values: tuple[Value, ...] = ()


def encode_frame(command: int, payload: bytes = b"") -> bytes:
    """Bytes of one frame; raises WsgError for an id outside u8 or a payload over MAX_PAYLOAD_BYTES."""
    if not 0 <= command <= 0xFF or len(payload) > MAX_PAYLOAD_BYTES:
        raise WsgError(
            f"frame id {command} with {len(payload)} bytes, expected id 0..255, <= {MAX_PAYLOAD_BYTES} bytes"
        )
    body = _HEADER.pack(PREAMBLE, command, len(payload)) + payload
    return body + _TRAILER.pack(crc16(body))


def _pack(layout: str, values: tuple[Value, ...], name: str) -> bytes:
    if any(isinstance(value, float) and not math.isfinite(value) for value in values):
        raise WsgError(f"{name} with values {values!r}, expected finite numbers", Status.INVALID_PARAMETER)
    try:
        return struct.pack(layout, *values)
    except (struct.error, OverflowError) as error:
        raise WsgError(f"{name} with values {values!r}: {error}", Status.INVALID_PARAMETER) from None


def _unpack(layout: str, payload: bytes, name: str) -> tuple[Value, ...]:
    size = struct.calcsize(layout)
    if len(payload) != size:
        status = Status.CMD_FORMAT_ERROR if size else Status.NO_PARAM_EXPECTED
        raise WsgError(f"{name} with {len(payload)} payload bytes, expected {size}", status)
    values: tuple[Value, ...] = struct.unpack(layout, payload)
    if any(isinstance(value, float) and not math.isfinite(value) for value in values):
        raise WsgError(f"{name} with values {values!r}, expected finite numbers", Status.INVALID_PARAMETER)
    return values


def encode_request(command: Command, *values: Value) -> bytes:
    """Bytes of a request; raises WsgError for non-finite or wrongly counted values, and for the relative-move bit."""
    if command is Command.LOOP:
        return encode_frame(command, b"".join(value for value in values if isinstance(value, bytes)))
    if command is Command.MOVE and values and values[0] not in tuple(MoveFlag):
        raise WsgError(f"move flags {values[0]!r}, expected 0x00 (clamp) or 0x02 (stop on block)")
    return encode_frame(command, _pack(_REQUEST[command], values, command.name))


def decode_request(frame: Frame) -> Request:
    """The gripper's side; raises WsgError whose ``status`` is the answer to send."""
    try:
        command = Command(frame.command)
    except ValueError:
        raise WsgError(f"command 0x{frame.command:02X} is not known", Status.CMD_UNKNOWN) from None
    if command is Command.LOOP:
        return Request(command, (frame.payload,))
    return Request(command, _unpack(_REQUEST[command], frame.payload, command.name))


def encode_reply(command: int, status: Status, *values: Value) -> bytes:
    """Bytes of a reply or auto-update; values are sent only with SUCCESS."""
    payload = struct.pack("<H", status)
    if status is Status.SUCCESS:
        if command == Command.LOOP:
            payload += b"".join(value for value in values if isinstance(value, bytes))
        elif command in _REPLY:
            payload += _pack(_REPLY[Command(command)], values, Command(command).name)
    return encode_frame(command, payload)


def decode_reply(frame: Frame) -> Reply:
    """The client's side; raises WsgError for an unknown status or parameters of the wrong length."""
    if len(frame.payload) < 2:
        raise WsgError(f"reply 0x{frame.command:02X} of {len(frame.payload)} bytes, expected a status of 2 bytes")
    (code,) = struct.unpack_from("<H", frame.payload)
    try:
        status = Status(code)
    except ValueError:
        raise WsgError(f"reply 0x{frame.command:02X} with status {code}, expected 0..30") from None
    params = frame.payload[2:]
    if status is not Status.SUCCESS:
        return Reply(frame.command, status)
    if frame.command not in _REPLY:
        return Reply(frame.command, status, (params,) if params else ())
    command = Command(frame.command)
    return Reply(command, status, _unpack(_REPLY[command], params, command.name))


@dataclass(slots=True)
class StreamParser:
    """Finds frames in a TCP byte stream of any segmentation and recovers after garbage or a wrong CRC.

    On failure only one byte is dropped, not the claimed length, so a damaged length hides no later frame.
    """

    _buffer: bytearray = field(default_factory=bytearray)

    def feed(self, data: bytes) -> list[Frame]:
        """All frames that ``data`` completes, in order."""
        self._buffer += data
        return list(self._frames())

    def _skip(self, count: int) -> None:
        del self._buffer[:count]

    def _seek(self) -> bool:
        """Drop bytes that cannot begin a frame; True if a full header lies at the start of the buffer."""
        while True:
            start = self._buffer.find(PREAMBLE)
            if start < 0:
                keep = next((n for n in (2, 1) if self._buffer.endswith(PREAMBLE[:n])), 0)
                self._skip(len(self._buffer) - keep)
                return False
            self._skip(start)
            if len(self._buffer) < _HEADER.size:
                return False
            _, command, length = _HEADER.unpack_from(self._buffer)
            # 0xAA is no command: four AA in a row are a stray byte and a preamble
            if command != PREAMBLE[0] and length <= MAX_PAYLOAD_BYTES:
                return True
            self._skip(1)

    def _frames(self) -> Iterator[Frame]:
        while self._seek():
            _, command, length = _HEADER.unpack_from(self._buffer)
            end = _HEADER.size + length
            if len(self._buffer) < end + _TRAILER.size:
                return
            body = bytes(self._buffer[:end])
            (crc,) = _TRAILER.unpack_from(self._buffer, end)
            if crc != crc16(body):
                self._skip(1)
                continue
            del self._buffer[: end + _TRAILER.size]
            yield Frame(command, body[_HEADER.size :])
