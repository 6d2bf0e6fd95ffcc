"""LitServe's side of `make bench-serving`: the ONNX file behind its HTTP server, tensors as base64 in JSON."""

import base64
import sys

import litserve
import numpy as np
import onnxruntime as ort


class OnnxApi(litserve.LitAPI):
    def setup(self, device: str) -> None:  # noqa: ARG002 - LitServe calls it so
        options = ort.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self.session = ort.InferenceSession(sys.argv[1], options, providers=["CPUExecutionProvider"])
        self.names = [output.name for output in self.session.get_outputs()]

    def decode_request(self, request: dict) -> dict:
        return {
            name: np.frombuffer(base64.b64decode(entry["data"]), entry["dtype"]).reshape(entry["shape"])
            for name, entry in request.items()
        }

    def predict(self, inputs: dict) -> list:
        return self.session.run(self.names, inputs)

    def encode_response(self, values: list) -> dict:
        return {name: value.tolist() for name, value in zip(self.names, values, strict=True)}


if __name__ == "__main__":
    server = litserve.LitServer(OnnxApi(), accelerator="cpu", workers_per_device=1)
    server.run(host="127.0.0.1", port=int(sys.argv[2]), log_level="error", generate_client_file=False)
