"""Runs a network in another interpreter: KIND, model, inputs (.npz), outputs (.npz; onnxsim: a model)."""

import sys
from importlib.metadata import version

import numpy as np


def with_onnxruntime(model, inputs, outputs):
    import onnxruntime

    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    np.savez(outputs, **dict(zip(names, session.run(names, inputs), strict=True)))


def with_openvino(model, inputs, outputs):
    import openvino

    compiled = openvino.compile_model(model, "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    results = compiled(inputs)
    np.savez(outputs, **{output.get_any_name(): results[output] for output in compiled.outputs})


def with_onnxsim(model, _inputs, outputs):
    import onnx
    import onnxsim

    simplified, good = onnxsim.simplify(onnx.load(model))
    assert good
    onnx.save(simplified, outputs)


kind, model, inputs, outputs = sys.argv[1:]
{"onnxruntime": with_onnxruntime, "openvino": with_openvino, "onnxsim": with_onnxsim}[kind](
    model, dict(np.load(inputs)), outputs
)
print(version(kind))
