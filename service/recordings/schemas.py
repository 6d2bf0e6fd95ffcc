"""The schemas of a recording's topics, each of them always the same.

Pictures are Foxglove's published Protocol Buffers, markers have one of their own. All else is JSON, described by the
types that write it.
"""

import json
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any, Literal

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from pydantic import BaseModel, Field, JsonValue

from service.contract import Finger, wire

_Field = descriptor_pb2.FieldDescriptorProto
_MARKER_FIELDS = {
    "timestamp": _Field.TYPE_MESSAGE,
    "seq": _Field.TYPE_UINT64,
    "rows": _Field.TYPE_UINT64,
    "cols": _Field.TYPE_UINT64,
    "rest_px": _Field.TYPE_FLOAT,
    "displacement_px": _Field.TYPE_FLOAT,
    "residual_px": _Field.TYPE_FLOAT,
    "valid": _Field.TYPE_BYTES,
    "state": _Field.TYPE_STRING,
    "slip_score": _Field.TYPE_FLOAT,
    "slipping": _Field.TYPE_BYTES,
    "sticking": _Field.TYPE_BYTES,
}


def _markers_class() -> Any:
    """The message class of ``tactile_insertion.Markers``; fields ending in ``_px`` are packed arrays."""
    file = descriptor_pb2.FileDescriptorProto(
        name="tactile_insertion/Markers.proto",
        package="tactile_insertion",
        syntax="proto3",
        dependency=[timestamp_pb2.DESCRIPTOR.name],
    )
    message = file.message_type.add(name="Markers")
    for number, (name, kind) in enumerate(_MARKER_FIELDS.items(), 1):
        label = _Field.LABEL_REPEATED if name.endswith("_px") else _Field.LABEL_OPTIONAL
        made = message.field.add(name=name, number=number, type=kind, label=label)
        if kind == _Field.TYPE_MESSAGE:
            made.type_name = ".google.protobuf.Timestamp"
    pool = descriptor_pool.Default()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("tactile_insertion.Markers"))


Markers = _markers_class()
__all__ = ["TOPICS", "CompressedImage", "Markers", "RawImage", "descriptor_set", "encode", "json_schema"]


class Message(BaseModel):
    """One message of the wire, and who sent it."""

    sender: Literal["client", "service"] = Field(alias="from")
    message: wire.ClientMessage | wire.ServiceMessage


class Call(BaseModel):
    """One call into the session; ``now_ns`` is the service's monotonic clock. The same calls give the same messages."""

    call: Literal["message", "prime", "frame", "pair", "result", "tick", "camera_fault"]
    now_ns: int
    message: dict[str, JsonValue] | None = None
    finger: Finger | None = None
    seq: int | None = None
    left: int | None = None
    right: int | None = None
    generation: int | None = None
    code: str | None = None
    detail: str | None = None


class Beside(BaseModel):
    """What versions beside the active one would have answered to an attempt that it decided, by version."""

    attempt: int
    active: str
    answers: dict[str, dict[str, JsonValue]]


TOPICS: dict[str, type[BaseModel]] = {
    "/messages": Message,
    "/calls": Call,
    "/robot": wire.RobotSample,
    "/beside": Beside,
}


@cache
def json_schema(topic: str) -> tuple[str, bytes]:
    """Name and JSON schema of what a topic of :data:`TOPICS` holds."""
    kind = TOPICS[topic]
    schema = kind.model_json_schema(ref_template="#/$defs/{model}")
    return f"tactile_insertion.{kind.__name__}", json.dumps(schema).encode()


def encode(message_class: Any, values: Mapping[str, Any], log_ns: int) -> bytes:
    """Serialise a message of wall-clock time ``log_ns``; arrays and memory views are copied here."""
    plain = {name: value.ravel().tolist() if isinstance(value, np.ndarray) else value for name, value in values.items()}
    plain |= {name: bytes(value) for name, value in values.items() if isinstance(value, memoryview)}
    seconds, nanos = divmod(log_ns, 1_000_000_000)
    timestamp = timestamp_pb2.Timestamp(seconds=seconds, nanos=nanos)
    content: bytes = message_class(timestamp=timestamp, **plain).SerializeToString()
    return content


def descriptor_set(message_class: Any) -> bytes:
    """A serialised FileDescriptorSet with a message's file and every file that it depends on."""
    files = {file.name: file for file in _files(message_class.DESCRIPTOR.file)}
    described = descriptor_pb2.FileDescriptorSet()
    for file in files.values():
        file.CopyToProto(described.file.add())
    content: bytes = described.SerializeToString()
    return content


def _files(file: Any) -> Iterator[Any]:
    for needed in file.dependencies:
        yield from _files(needed)
    yield file
