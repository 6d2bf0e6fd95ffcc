"""Just enough of the Protocol Buffers encoding to write and read our MCAP channels, with their descriptors.

Foxglove and Rerun read ``foxglove.CompressedImage`` and ``foxglove.RawImage`` by name; markers carry their own schema.
"""

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

Kind = Literal["string", "bytes", "fixed32", "uint64", "float", "floats", "time"]
_TYPE = {"string": 9, "bytes": 12, "fixed32": 7, "uint64": 4, "float": 2, "floats": 2, "time": 11}


@dataclass(frozen=True, slots=True)
class Schema:
    """A message type: full name and fields (name, number, kind)."""

    name: str
    fields: tuple[tuple[str, int, Kind], ...]

    def encode(self, values: Mapping[str, Any]) -> bytes:
        """Serialise; ``time`` takes nanoseconds, ``floats`` the little-endian float32 bytes of an array."""
        return b"".join(_encode(number, kind, values[name]) for name, number, kind in self.fields if name in values)

    def decode(self, data: bytes) -> dict[str, Any]:
        """The inverse of :meth:`encode`."""
        by_number = {number: (name, kind) for name, number, kind in self.fields}
        found: dict[str, Any] = {}
        for number, raw in _records(data):
            if number in by_number:
                name, kind = by_number[number]
                found[name] = _decode(kind, raw)
        return found

    def descriptor_set(self) -> bytes:
        """A serialised FileDescriptorSet with this message and what it depends on."""
        package, _, short = self.name.rpartition(".")
        uses_time = any(kind == "time" for *_, kind in self.fields)
        fields = b"".join(_bytes(2, _field(name, number, kind)) for name, number, kind in self.fields)
        own = _bytes(1, f"{self.name.replace('.', '/')}.proto".encode()) + _bytes(2, package.encode())
        own += _bytes(3, b"google/protobuf/timestamp.proto") if uses_time else b""
        own += _bytes(4, _bytes(1, short.encode()) + fields) + _bytes(12, b"proto3")
        return (_bytes(1, _timestamp_file()) if uses_time else b"") + _bytes(1, own)


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _bytes(number: int, data: bytes) -> bytes:
    return _varint(number << 3 | 2) + _varint(len(data)) + data


def _number(number: int, value: int) -> bytes:
    return _varint(number << 3) + _varint(value)


def _time(nanoseconds: int) -> bytes:
    seconds, rest = divmod(nanoseconds, 1_000_000_000)
    return _number(1, seconds) + _number(2, rest)


def _encode(number: int, kind: Kind, value: Any) -> bytes:
    match kind:
        case "uint64":
            return _number(number, value)
        case "fixed32":
            return _varint(number << 3 | 5) + struct.pack("<I", value)
        case "float":
            return _varint(number << 3 | 5) + struct.pack("<f", value)
        case "time":
            return _bytes(number, _time(value))
        case "string":
            return _bytes(number, value.encode())
        case _:
            return _bytes(number, value)


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if not byte & 0x80:
            return value, at


def _records(data: bytes) -> Iterator[tuple[int, Any]]:
    at = 0
    while at < len(data):
        key, at = _read_varint(data, at)
        match key & 7:
            case 0:
                value, at = _read_varint(data, at)
                yield key >> 3, value
            case 2:
                length, at = _read_varint(data, at)
                yield key >> 3, data[at : at + length]
                at += length
            case 5:
                yield key >> 3, data[at : at + 4]
                at += 4
            case other:
                raise ValueError(f"wire type {other}, expected 0, 2 or 5")


def _decode(kind: Kind, raw: Any) -> Any:
    match kind:
        case "string":
            return bytes(raw).decode()
        case "fixed32":
            return struct.unpack("<I", raw)[0]
        case "float":
            return struct.unpack("<f", raw)[0]
        case "time":
            parts = dict(_records(raw))
            return parts.get(1, 0) * 1_000_000_000 + parts.get(2, 0)
        case _:
            return raw


def _field(name: str, number: int, kind: Kind) -> bytes:
    label = 3 if kind == "floats" else 1
    field = _bytes(1, name.encode()) + _number(3, number) + _number(4, label) + _number(5, _TYPE[kind])
    return field + (_bytes(6, b".google.protobuf.Timestamp") if kind == "time" else b"")


def _timestamp_file() -> bytes:
    fields = b"".join(
        _bytes(2, _bytes(1, name) + _number(3, number) + _number(4, 1) + _number(5, type_))
        for name, number, type_ in ((b"seconds", 1, 3), (b"nanos", 2, 5))
    )
    message = _bytes(4, _bytes(1, b"Timestamp") + fields)
    name = _bytes(1, b"google/protobuf/timestamp.proto") + _bytes(2, b"google.protobuf")
    return name + message + _bytes(12, b"proto3")


COMPRESSED_IMAGE = Schema(
    "foxglove.CompressedImage",
    (("timestamp", 1, "time"), ("data", 2, "bytes"), ("format", 3, "string"), ("frame_id", 4, "string")),
)
RAW_IMAGE = Schema(
    "foxglove.RawImage",
    (
        ("timestamp", 1, "time"),
        ("width", 2, "fixed32"),
        ("height", 3, "fixed32"),
        ("encoding", 4, "string"),
        ("step", 5, "fixed32"),
        ("data", 6, "bytes"),
        ("frame_id", 7, "string"),
    ),
)
MARKERS = Schema(
    "tactile_insertion.Markers",
    (
        ("timestamp", 1, "time"),
        ("seq", 2, "uint64"),
        ("rows", 3, "uint64"),
        ("cols", 4, "uint64"),
        ("rest_px", 5, "floats"),
        ("displacement_px", 6, "floats"),
        ("residual_px", 7, "floats"),
        ("valid", 8, "bytes"),
        ("state", 9, "string"),
        ("slip_score", 10, "float"),
    ),
)
