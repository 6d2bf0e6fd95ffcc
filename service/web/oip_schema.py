"""The Open Inference Protocol's request as a JSON schema, for the OpenAPI description."""

from typing import Any

_NAME = {"type": "string", "minLength": 1}
_PARAMETERS = {"type": "object", "additionalProperties": True}
_INPUT: dict[str, Any] = {
    "type": "object",
    "required": ["name", "shape", "datatype"],
    "properties": {
        "name": _NAME,
        "shape": {"type": "array", "items": {"type": "integer", "minimum": 1}},
        "datatype": {"enum": ["BOOL", "UINT8", "INT8", "INT16", "INT32", "INT64", "FP16", "FP32", "FP64"]},
        "parameters": _PARAMETERS,
        "data": {"type": "array"},
    },
}
INFER_SCHEMA: dict[str, Any] = {
    "type": "object",
    "required": ["inputs"],
    "properties": {
        "id": {"type": "string"},
        "parameters": _PARAMETERS,
        "inputs": {"type": "array", "items": _INPUT},
        "outputs": {
            "type": "array",
            "items": {"type": "object", "required": ["name"], "properties": {"name": _NAME, "parameters": _PARAMETERS}},
        },
    },
}
