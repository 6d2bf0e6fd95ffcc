"""The light packages stay light: each is imported in a new interpreter, which then lists the loaded modules."""

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


@pytest.mark.parametrize("package", LIGHT)
def test_a_light_package_does_not_load_a_heavy_one(package):
    code = f"import sys, {package}; print([m for m in {LIGHT[package]!r} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "[]"
