"""Exported networks in the oldest onnxruntime that they are made for: another interpreter, which need not be there."""

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from export.onnx.golden import golden_input
from export.onnx.model import open_model
from export.onnx.runtime import session

SCRIPT = Path(__file__).with_name("run_elsewhere.py")


def example(file):
    """Inputs of a step at batch 1."""
    model = open_model(file)
    made = {}
    frames = golden_input(model.card)
    for entry in session(file).get_inputs():
        shape = [size if isinstance(size, int) else 1 for size in entry.shape]
        if entry.name in {"frame", "reference"}:
            made[entry.name] = np.asarray(frames).reshape(-1, *shape[1:])[:1]
        else:
            made[entry.name] = np.full(shape, 0.5, np.float32)
    return made


@pytest.mark.parametrize("name", ["direction.step", "magnitude.step"])
def test_the_oldest_runtime_says_what_the_newest_says(models, tmp_path, name):
    python = os.environ.get("OLD_RUNTIME_PYTHON")
    if not python:
        pytest.skip("set OLD_RUNTIME_PYTHON to a Python with onnxruntime 1.17 (make peers does)")
    file = models / f"{name}.onnx"
    inputs = example(file)
    np.savez(tmp_path / "in.npz", **inputs)
    command = [python, str(SCRIPT), str(file), str(tmp_path / "in.npz"), str(tmp_path / "out.npz")]
    version = subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
    assert version.startswith("1.17")
    here = session(file)
    wanted = dict(zip([o.name for o in here.get_outputs()], here.run(None, inputs), strict=True))
    with np.load(tmp_path / "out.npz") as found:
        for output, values in wanted.items():
            np.testing.assert_allclose(found[output], values, atol=1e-4)
