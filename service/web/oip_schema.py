"""The Open Inference Protocol's request and answer as JSON schemas, for the OpenAPI description."""

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
_REQUEST = _object(
    ["inputs"],
    id={"type": "string"},
    parameters=_object([], binary_data_output={"type": "boolean"}),
    inputs={"type": "array", "items": _INPUT},
    outputs={"type": "array", "items": _OUTPUT},
)
_RESULT = _object(
    ["name", "datatype", "shape"],
    name=_NAME,
    datatype={"enum": list(DATATYPES)},
    shape={"type": "array", "items": {"type": "integer", "minimum": 0}},
    parameters=_object(["binary_data_size"], binary_data_size={"type": "integer", "minimum": 0}),
    data={"type": "array"},
)
_ANSWER = _object(
    ["model_name", "model_version", "outputs"],
    model_name=_NAME,
    model_version=_NAME,
    id={"type": "string"},
    outputs={"type": "array", "items": _RESULT},
)
_BINARY = {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}
_LENGTH = {
    "name": "Inference-Header-Content-Length",
    "in": "header",
    "description": "of the JSON before binary tensors",
}
INFERENCE: dict[str, Any] = {
    "parameters": [_LENGTH | {"schema": {"type": "integer", "minimum": 0}}],
    "requestBody": {"required": True, "content": {"application/json": {"schema": _REQUEST}} | _BINARY},
    "responses": {"200": {"content": {"application/json": {"schema": _ANSWER}} | _BINARY}},
}
"""What of an inference the code does not tell by itself; ``infer`` answers in JSON unless binary tensors follow it."""
