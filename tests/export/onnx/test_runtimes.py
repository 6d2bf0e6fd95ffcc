"""Exported networks, and those that a cell loads, in foreign runtimes: other interpreters, which need not be there."""

import os
import subprocess
from pathlib import Path

import numpy as np
import onnx
import pytest

from export.onnx.golden import golden_input
from export.onnx.model import open_model
from export.onnx.runtime import session

SCRIPT = Path(__file__).with_name("run_elsewhere.py")
RELEASED = Path(__file__).parents[3] / "models" / "pressing"
FILES = ("direction.step", "magnitude.step", "pressing/pair.step", "pressing/joint/joint.step")


@pytest.fixture(params=FILES)
def file(request, models):
    """Two that were just exported, and the two that are released."""
    folder, _, name = request.param.rpartition("pressing/")
    return (RELEASED if "pressing" in request.param else models) / f"{folder}{name}.onnx"


def example(file):
    """Inputs of a step at batch 1."""
    made = {}
    frames = np.asarray(golden_input(open_model(file).card))
    for entry in session(file).get_inputs():
        shape = [size if isinstance(size, int) else 1 for size in entry.shape]
        if entry.name in {"frame", "reference"}:
            made[entry.name] = frames.reshape(-1, *shape[1:])[-1:] if entry.name == "frame" else frames[:1]
        else:
            made[entry.name] = np.full(shape, 0.5, np.float32)
    return made


def results(file, inputs):
    run = session(file)
    return dict(zip([output.name for output in run.get_outputs()], run.run(None, inputs), strict=True))


def elsewhere(variable, what, file, folder, suffix=".npz"):
    """Another interpreter's output for a file, and the version used."""
    python = os.environ.get(variable)
    if not python:
        pytest.skip(f"set {variable} to a Python with {what} (make peers does)")
    np.savez(folder / "in.npz", **example(file))
    made = folder / f"out{suffix}"
    command = [python, str(SCRIPT), what, str(file), str(folder / "in.npz"), str(made)]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return made, done.stdout.strip().splitlines()[-1]


def same(outputs, file):
    for output, values in results(file, example(file)).items():
        np.testing.assert_allclose(outputs[output], values, atol=1e-4, rtol=1e-4)


def test_the_oldest_runtime_says_what_the_newest_says(file, tmp_path):
    made, version = elsewhere("OLD_RUNTIME_PYTHON", "onnxruntime", file, tmp_path)
    assert version.startswith("1.17")
    with np.load(made) as outputs:
        same(outputs, file)


def test_openvino_says_what_onnxruntime_says(file, tmp_path):
    made, _ = elsewhere("GRAPH_PYTHON", "openvino", file, tmp_path)
    with np.load(made) as outputs:
        same(outputs, file)


def test_onnxsim_simplifies_it_to_a_graph_that_says_the_same(file, tmp_path):
    made, _ = elsewhere("GRAPH_PYTHON", "onnxsim", file, tmp_path, ".onnx")
    same(results(made, example(file)), file)


def test_the_files_are_of_the_oldest_form_that_the_graph_can_have(models):
    """IR 8 and opset 18: the sums and splits of these graphs are of 18, and 1.17 reads up to IR 9 and opset 20."""
    for file in models.glob("*.onnx"):
        model = onnx.load(str(file))
        assert (model.ir_version, model.opset_import[0].version) == (8, 18)
        assert not any(node.metadata_props for node in model.graph.node)
        model.opset_import[0].version = 17
        with pytest.raises(onnx.checker.ValidationError):
            onnx.checker.check_model(model, full_check=True)


def test_what_is_shipped_is_read_by_the_oldest_runtime_and_carries_no_traces_of_the_exporter():
    for file in RELEASED.parent.rglob("*.onnx"):
        model = onnx.load(str(file))
        assert model.ir_version == 8
        assert model.opset_import[0].version == 18
        assert not any(node.metadata_props for node in model.graph.node)
