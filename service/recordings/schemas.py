"""The Protocol Buffers in a recording: Foxglove's published pictures, and markers with a schema of their own."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2

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
__all__ = ["CompressedImage", "Markers", "RawImage", "descriptor_set", "encode"]


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
