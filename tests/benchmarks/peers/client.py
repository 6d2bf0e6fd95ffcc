"""The client of `make bench-serving`: one closed loop, the servers in turn, so that noise meets them all alike.

usage: client.py MODEL.onnx MODEL_NAME SECONDS name=kind@address ...   kinds: oip, grpc, litserve. Prints JSON.
Runs in the peers' environment; imports nothing of this repository.
"""

import base64
import http.client
import json
import os
import sys
import time
from collections.abc import Callable

import numpy as np
import onnxruntime as ort

TYPES = {"tensor(uint8)": ("UINT8", np.uint8), "tensor(float)": ("FP32", np.float32)}
ROUND = 10  # calls in a row to one server


def example(session: ort.InferenceSession) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    made = {}
    for entry in session.get_inputs():
        shape = [size if isinstance(size, int) else 1 for size in entry.shape]
        kind = TYPES[entry.type][1]
        made[entry.name] = rng.integers(0, 255, shape).astype(kind) if kind is np.uint8 else np.ones(shape, kind)
    return made


def oip(address: str, model: str, inputs: dict[str, np.ndarray], names: list[str]) -> Callable[[], np.ndarray]:
    import tritonclient.http as triton

    client, token = triton.InferenceServerClient(address), os.environ["TOKEN"]

    class Bearer(triton.InferenceServerClientPlugin):
        def __call__(self, request):
            request.headers["Authorization"] = f"Bearer {token}"

    client.register_plugin(Bearer())
    return _triton(triton, client, model, inputs, names, {"binary_data": True})


def grpc(address: str, model: str, inputs: dict[str, np.ndarray], names: list[str]) -> Callable[[], np.ndarray]:
    import tritonclient.grpc as triton

    return _triton(triton, triton.InferenceServerClient(address), model, inputs, names, {})


def _triton(triton, client, model, inputs, names, options):
    def call() -> np.ndarray:
        asked = []
        for name, values in inputs.items():
            kind = "UINT8" if values.dtype == np.uint8 else "FP32"
            asked.append(triton.InferInput(name, list(values.shape), kind))
            asked[-1].set_data_from_numpy(values)
        wanted = [triton.InferRequestedOutput(name, **options) for name in names]
        answer = client.infer(model, asked, outputs=wanted)
        return answer.as_numpy(names[0])

    return call


def litserve(address: str, _: str, inputs: dict[str, np.ndarray], names: list[str]) -> Callable[[], np.ndarray]:
    connection = http.client.HTTPConnection(address, timeout=30)

    def call() -> np.ndarray:
        body = {
            name: {"data": base64.b64encode(v.tobytes()).decode(), "dtype": str(v.dtype), "shape": v.shape}
            for name, v in inputs.items()
        }
        connection.request("POST", "/predict", json.dumps(body), {"Content-Type": "application/json"})
        return np.asarray(json.loads(connection.getresponse().read())[names[0]], np.float32)

    return call


def main(path: str, model: str, seconds: float, servers: list[str]) -> None:
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = ort.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    inputs = example(session)
    calls = {"in process": lambda: session.run(names, inputs)[0]}
    for server in servers:
        name, _, place = server.partition("=")
        kind, _, address = place.partition("@")
        calls[name] = {"oip": oip, "grpc": grpc, "litserve": litserve}[kind](address, model, inputs, names)
    expected = calls["in process"]()
    for name, call in calls.items():
        for _ in range(ROUND):
            np.testing.assert_allclose(call(), expected, rtol=1e-4, atol=1e-4, err_msg=name)
    taken: dict[str, list[float]] = {name: [] for name in calls}
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        for name, call in calls.items():
            for _ in range(ROUND):
                started = time.perf_counter()
                call()
                taken[name].append((time.perf_counter() - started) * 1e3)
    quantiles = {name: np.percentile(values, (50, 99)).tolist() for name, values in taken.items()}
    facts = {n: {"p50_ms": p50, "p99_ms": p99, "calls_n": len(taken[n])} for n, (p50, p99) in quantiles.items()}
    print(json.dumps({"payload_bytes": sum(v.nbytes for v in inputs.values()), "servers": facts}))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]), sys.argv[4:])
