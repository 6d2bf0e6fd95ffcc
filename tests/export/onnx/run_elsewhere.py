"""Runs a network with the onnxruntime of whatever interpreter this is: model, inputs (.npz), outputs (.npz)."""

import sys

import numpy as np
import onnxruntime

model, inputs, outputs = sys.argv[1:]
session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
names = [output.name for output in session.get_outputs()]
np.savez(outputs, **dict(zip(names, session.run(names, dict(np.load(inputs))), strict=True)))
print(onnxruntime.__version__)
