"""The product on the cell PC: streams both fingers, detects incipient slip, decides the correction."""

import os

# onnxruntime reports its use to its makers, unless this is set before it is loaded.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

__version__ = "0.2.0.dev0"
