"""The wheel works alone: installed into a fresh environment, run from an empty folder."""

import importlib
import runpy
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest
from google.protobuf import runtime_version

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


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


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_wheel_holds_nothing_that_the_checkout_no_longer_has(tmp_path):
    """A build that leaves a copy behind would install a removed object or sensor again with the next version."""
    checkout = tmp_path / "checkout"
    for package in PROJECT["tool"]["importlinter"]["root_packages"]:
        (checkout / package).mkdir(parents=True)
        (checkout / package / "__init__.py").touch()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        (checkout / name).write_bytes((ROOT / name).read_bytes())
    for name in ("models", "simulation/objects"):
        (checkout / name).mkdir()
    for name in ("models/network.onnx", "simulation/objects/old_box.toml", "simulation/objects/new_box.toml"):
        (checkout / name).touch()

    def objects():
        pip = [sys.executable, "-m", "pip", "-q", "wheel", "--no-deps", "-w", str(tmp_path / "wheels"), str(checkout)]
        subprocess.run(pip, check=True, timeout=300)
        (wheel,) = (tmp_path / "wheels").glob("*.whl")
        return {Path(name).name for name in zipfile.ZipFile(wheel).namelist() if name.startswith("simulation/objects")}

    assert objects() == {"old_box.toml", "new_box.toml"}
    (checkout / "simulation" / "objects" / "old_box.toml").unlink()
    assert objects() == {"new_box.toml"}


@pytest.mark.parametrize(
    ("extra", "generated"),
    [
        ("service", "foxglove_schemas_protobuf.RawImage_pb2"),
        ("robot", "robot_client.robots.abb_egm.tactile_insertion_egm_pb2"),
    ],
)
def test_generated_code_runs_with_the_lowest_protobuf_allowed(extra, generated, monkeypatch):
    """Foxglove's package asks for 3.20 and refuses what is older than its generator, so the bound is ours to state."""
    code = importlib.import_module(generated).__file__  # what it imports in turn is protobuf's own, as installed
    (lowest,) = (line for line in PROJECT["project"]["optional-dependencies"][extra] if line.startswith("protobuf>="))
    for part, number in zip(("MAJOR", "MINOR", "PATCH"), lowest.removeprefix("protobuf>=").split("."), strict=True):
        monkeypatch.setattr(runtime_version, part, int(number))
    assert "DESCRIPTOR" in runpy.run_path(code)


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
def test_what_a_driver_of_your_own_imports_is_typed(installed, tmp_path):
    """Without a mark, the types of a port are those of anything: they rest on the contract's."""
    code = "import service, robot_client; print(*service.__path__, *robot_client.__path__, sep='\\n')"
    done = subprocess.run([installed, "-c", code], cwd=tmp_path, check=True, capture_output=True, text=True, timeout=60)
    folders = done.stdout.splitlines()
    assert len(folders) == 2
    assert all(Path(folder, "py.typed").is_file() for folder in folders)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_installed_loop_inserts_an_object(installed, tmp_path):
    done = run(installed, tmp_path, "run", "--object", "circle")
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    assert "INSERTED" in done.stdout
