"""From checkpoint to verified ONNX file, and its cost on this machine."""

import os

# onnxruntime reports its use to its makers, unless this is set before it is loaded.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
