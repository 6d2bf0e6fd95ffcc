"""The wheel works alone: installed into a fresh environment, run from an empty folder."""

import subprocess
import sys
import sysconfig
import tomllib
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Python of an environment with the wheel and this environment's dependencies."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "-q"]
    subprocess.run([*pip, "wheel", "--no-deps", "-w", str(folder), str(ROOT)], check=True, timeout=300)
    venv.create(folder / "venv", with_pip=True)
    python = folder / "venv" / "bin" / "python"
    wheel = next(folder.glob("*.whl"))
    # Isolated, and before it borrows: where pip finds this project on a path, it calls the wheel installed.
    subprocess.run([python, "-I", "-m", "pip", "-q", "install", "--no-deps", str(wheel)], check=True, timeout=300)
    where = "import sysconfig; print(sysconfig.get_path('purelib'))"
    site = subprocess.run([python, "-c", where], check=True, capture_output=True, text=True, timeout=60)
    Path(site.stdout.strip(), "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return python


def test_what_the_wheel_carries_beside_the_code_are_files():
    """A pattern that takes in a folder breaks every build."""
    carried = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["data-files"]
    for pattern in (pattern for patterns in carried.values() for pattern in patterns):
        paths = list(ROOT.glob(pattern))
        assert paths, pattern
        assert all(path.is_file() for path in paths), pattern


def run(python, folder, *words):
    command = [python.parent / "tactile-insertion", *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_wheel_brings_its_models_objects_and_configurations(installed, tmp_path):
    assert "accuracy" in run(installed, tmp_path, "models").stdout
    assert run(installed, tmp_path, "explain", "rectangle").returncode == 0
    probe = run(installed, tmp_path, "probe", "rectangle", "--x-mm", "8", "--theta-deg", "5")
    assert probe.returncode == 0, probe.stderr


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_installed_loop_inserts_an_object(installed, tmp_path):
    done = run(installed, tmp_path, "run", "--object", "circle")
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    assert "INSERTED" in done.stdout
