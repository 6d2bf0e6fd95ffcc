"""The light packages stay light: each is imported in a new interpreter, which then lists the loaded modules."""

import os
import subprocess
import sys

import pytest

LIGHT = {
    "service.contract": ("torch", "numba", "cv2", "onnxruntime", "fastapi"),
    "service.perception.slip.detector": ("torch", "numba", "onnxruntime", "fastapi"),
    "service.web.app": ("torch", "numba", "simulation", "training"),
    ", ".join(
        f"robot_client.{name}" for name in ("__main__", "cli.insert", "cli.check", "cli.jog", "session.replay")
    ): (
        "torch",
        "numba",
        "cv2",
        "onnxruntime",
        "fastapi",
        "simulation",
        "service.perception",
    ),
    "simulation.__main__": ("torch", "onnxruntime", "training"),
    "simulation.cli.run": ("torch", "onnxruntime", "numba", "scipy", "fastapi"),  # `make demo` shows a picture soon
    "simulation.data.dataset": ("torch", "onnxruntime"),
}


@pytest.mark.parametrize("package", ["service.session.manager", "export.onnx.runtime"])
def test_onnxruntime_reports_its_use_to_nobody(package, tmp_path):
    """Where it does, it first keeps a name of the machine, and what it has not sent yet, in the user's home."""
    mine = {
        name: value for name, value in os.environ.items() if name not in {"ORT_DISABLE_TELEMETRY", "XDG_CACHE_HOME"}
    }
    command = [sys.executable, "-c", f"import {package}, onnxruntime"]
    subprocess.run(command, env=mine | {"HOME": str(tmp_path)}, timeout=60, check=True)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("package", LIGHT)
def test_a_light_package_does_not_load_a_heavy_one(package):
    code = f"import sys, {package}; print([m for m in {LIGHT[package]!r} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "[]"
