"""The Open Inference Protocol's request as a JSON schema, for the OpenAPI description: what is read, and no more."""

from typing import Any

from service.web.oip_tensors import DATATYPES

_NAME = {"type": "string", "minLength": 1}


def _object(required: list[str], **properties: Any) -> dict[str, Any]:
    return {"type": "object", "required": required, "properties": properties, "additionalProperties": False}


_INPUT = _object(
    ["name", "shape", "datatype"],
    name=_NAME,
    shape={"type": "array", "items": {"type": "integer", "minimum": 1}},
    datatype={"enum": list(DATATYPES)},
    parameters=_object([], binary_data_size={"type": "integer", "minimum": 0}),
    data={"type": "array"},
)
_OUTPUT = _object(["name"], name=_NAME, parameters=_object([], binary_data={"type": "boolean"}))
INFER_SCHEMA: dict[str, Any] = _object(
    ["inputs"],
    id={"type": "string"},
    parameters=_object([], binary_data_output={"type": "boolean"}),
    inputs={"type": "array", "items": _INPUT},
    outputs={"type": "array", "items": _OUTPUT},
)
