"""The Open Inference Protocol's tensors: JSON or binary in, JSON or binary out.

A binary body is the JSON request, whose length ``Inference-Header-Content-Length`` gives, followed by the raw
little-endian row-major tensors in the order of the JSON.
"""

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from service.contract import ContractError
from service.decision.models import Array, LoadedModel

DATATYPES: dict[str, Any] = {
    "BOOL": np.bool_,
    "UINT8": np.uint8,
    "INT8": np.int8,
    "INT16": np.int16,
    "INT32": np.int32,
    "INT64": np.int64,
    "FP16": np.float16,
    "FP32": np.float32,
    "FP64": np.float64,
}
_NAMES = {np.dtype(value): key for key, value in DATATYPES.items()}
_ORT_NAMES = {"tensor(float)": "FP32", "tensor(uint8)": "UINT8", "tensor(int64)": "INT64", "tensor(double)": "FP64"}
REQUEST_KEYS = {"id", "parameters", "inputs", "outputs"}
INPUT_KEYS = {"name", "shape", "datatype", "parameters", "data"}
OUTPUT_KEYS = {"name", "parameters"}
MAX_ELEMENTS = 1 << 25
MAX_JSON_BYTES = 6 << 20  # as Python objects, text takes thirty times its size


class TensorError(ContractError):
    """A request violates the protocol or the model's inputs."""


@dataclass(frozen=True, slots=True)
class InferRequest:
    """A parsed request; ``binary``: for each wanted output, whether it goes out in binary."""

    id: str | None
    inputs: dict[str, Array]
    binary: dict[str, bool]


def metadata(model: LoadedModel) -> dict[str, Any]:
    """Names, types and shapes of a model's inputs and outputs; the batch is -1."""

    def tensor(entry: Any) -> dict[str, Any]:
        shape = [size if isinstance(size, int) else -1 for size in entry.shape]
        return {"name": entry.name, "datatype": _ORT_NAMES.get(entry.type, "FP32"), "shape": shape}

    return {
        "inputs": [tensor(entry) for entry in model.inputs],
        "outputs": [tensor(entry) for entry in model.outputs],
    }


def parse_request(body: bytes | bytearray, header_length: str | None, model: LoadedModel) -> InferRequest:
    """Parse an infer request; raise TensorError naming the fault. Binary tensors are views of the body."""
    split = len(body) if header_length is None else _length(header_length, len(body))
    if split > MAX_JSON_BYTES:
        raise TensorError(f"JSON of {split} bytes, expected at most {MAX_JSON_BYTES}; send tensors in binary")
    try:
        request = json.loads(body[:split])
    except (ValueError, RecursionError) as error:
        raise TensorError(f"request is no JSON: {error}") from error
    if not isinstance(request, dict) or not isinstance(request.get("inputs"), list):
        raise TensorError("request needs a list of inputs")
    _only(request, "request", REQUEST_KEYS, {"binary_data_output"})
    known = metadata(model)
    inputs = _inputs(request["inputs"], memoryview(body)[split:], {entry["name"]: entry for entry in known["inputs"]})
    return InferRequest(_id(request), inputs, _wanted(request, [entry["name"] for entry in known["outputs"]]))


def _length(text: str, most: int) -> int:
    """The length that a header states."""
    if not (re.fullmatch("[0-9]{1,19}", text) and int(text) <= most):
        raise TensorError(f"Inference-Header-Content-Length {text[:20]!r}, expected a length within the body")
    return int(text)


def _id(request: Mapping[str, Any]) -> str | None:
    value = request.get("id")
    return None if value is None else str(value)


def _parameters(entry: Any) -> Mapping[str, Any]:
    value = entry.get("parameters") if isinstance(entry, dict) else None
    if not (value is None or isinstance(value, dict)):
        raise TensorError(f"parameters {value!r}, expected an object")
    return value or {}


def _only(entry: Mapping[str, Any], what: str, keys: set[str], parameters: set[str]) -> None:
    """Raise TensorError naming an unsupported key: ignoring it would make it look supported."""
    for kind, given, known in (("", entry, keys), ("parameter ", _parameters(entry), parameters)):
        for name in given:
            if name not in known:
                raise TensorError(f"{what}: {kind}{name} is not supported, expected {sorted(known)}")


def _inputs(entries: list[Any], tail: memoryview, known: Mapping[str, Any]) -> dict[str, Array]:
    inputs: dict[str, Array] = {}
    at = 0
    for entry in entries:
        name = entry.get("name") if isinstance(entry, dict) else None
        if not isinstance(name, str) or name not in known or name in inputs:
            raise TensorError(f"input {name!r}, expected each of {sorted(known)} once")
        _only(entry, f"input {name}", INPUT_KEYS, {"binary_data_size"})
        size = _parameters(entry).get("binary_data_size")
        if size is not None and (not isinstance(size, int) or size < 0 or at + size > len(tail)):
            raise TensorError(f"input {name}: binary_data_size {size}, {len(tail) - at} bytes are left")
        inputs[name] = _tensor(entry, None if size is None else tail[at : at + size], known[name])
        at += size or 0
    if set(inputs) != set(known):
        raise TensorError(f"inputs {sorted(inputs)}, expected {sorted(known)}")
    if at != len(tail):
        raise TensorError(f"{len(tail) - at} bytes follow the last tensor")
    return inputs


def _tensor(entry: Mapping[str, Any], data: memoryview | None, known: Mapping[str, Any]) -> Array:
    """One input: from its binary ``data``, or from the JSON if there is none."""
    name, shape, dtype = entry["name"], _shape(entry, known), np.dtype(DATATYPES[known["datatype"]])
    count = math.prod(shape)
    if data is not None:
        if len(data) != count * dtype.itemsize:
            raise TensorError(f"input {name} has {len(data)} bytes, expected {count * dtype.itemsize}")
        return _finite(f"input {name}", np.frombuffer(data, dtype).reshape(shape))
    try:
        values: Array = np.asarray(entry.get("data"), np.float64)
        if dtype.kind in "iu" and not ((values >= np.iinfo(dtype).min) & (values <= np.iinfo(dtype).max)).all():
            raise TensorError(f"input {name} has values outside {known['datatype']}")
        with np.errstate(over="ignore"):
            values = values.astype(dtype).reshape(shape)
    except (TypeError, ValueError, OverflowError) as error:
        raise TensorError(f"input {name}: {error}") from error
    return _finite(f"input {name}", values)


def _finite(name: str, values: Array) -> Array:
    """The same values; raises TensorError for null, NaN and infinity, which no network was trained on."""
    if not np.isfinite(values).all():
        raise TensorError(f"{name} has values that are not finite numbers")
    return values


def _shape(entry: Mapping[str, Any], known: Mapping[str, Any]) -> tuple[int, ...]:
    """The shape of an input, checked against the model's type and shape."""
    name, datatype, shape = entry["name"], entry.get("datatype"), entry.get("shape")
    if datatype != known["datatype"]:
        raise TensorError(f"input {name} is {datatype}, expected {known['datatype']}")
    fits = isinstance(shape, list) and len(shape) == len(known["shape"]) and all(type(n) is int for n in shape)
    if not fits or any(n < 1 or (k >= 0 and n != k) for n, k in zip(shape or [], known["shape"], strict=False)):
        raise TensorError(f"input {name} has shape {shape}, expected {known['shape']}")
    assert isinstance(shape, list)
    if math.prod(shape) > MAX_ELEMENTS:
        raise TensorError(f"input {name} has {math.prod(shape)} elements, expected at most {MAX_ELEMENTS}")
    return tuple(shape)


def _wanted(request: Mapping[str, Any], names: list[str]) -> dict[str, bool]:
    everything = bool(_parameters(request).get("binary_data_output", False))
    outputs = request.get("outputs")
    if not outputs:
        return dict.fromkeys(names, everything)
    wanted: dict[str, bool] = {}
    for entry in outputs if isinstance(outputs, list) else [outputs]:
        name = entry.get("name") if isinstance(entry, dict) else None
        if name not in names:
            raise TensorError(f"output {name!r}, expected one of {names}")
        _only(entry, f"output {name}", OUTPUT_KEYS, {"binary_data"})
        wanted[str(name)] = bool(_parameters(entry).get("binary_data", everything))
    return wanted


def encode_response(
    model_name: str, request: InferRequest, outputs: Mapping[str, Array]
) -> tuple[bytes, dict[str, str]]:
    """Body and headers of an infer response."""
    values = {name: _finite(f"output {name}", np.ascontiguousarray(outputs[name])) for name in request.binary}
    tail = [values[name].tobytes() for name, binary in request.binary.items() if binary]
    head = _described_outputs(model_name, request, values)
    if not tail:
        return head, {"Content-Type": "application/json"}
    headers = {"Content-Type": "application/octet-stream", "Inference-Header-Content-Length": str(len(head))}
    return b"".join((head, *tail)), headers


def _described_outputs(model_name: str, request: InferRequest, values: Mapping[str, Array]) -> bytes:
    """The JSON of a response: descriptions of its tensors, and the values of those not sent in binary."""
    described: list[dict[str, Any]] = []
    for name, array in values.items():
        entry: dict[str, Any] = {"name": name, "datatype": _NAMES[array.dtype], "shape": list(array.shape)}
        if request.binary[name]:
            entry["parameters"] = {"binary_data_size": array.nbytes}
        else:
            entry["data"] = array.ravel().tolist()
        described.append(entry)
    answer: dict[str, Any] = {"model_name": model_name, "model_version": "1", "outputs": described}
    if request.id is not None:
        answer["id"] = request.id
    return json.dumps(answer).encode()
