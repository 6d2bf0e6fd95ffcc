import pytest

from simulation.data import sources
from simulation.data.sources import sources_sha256


def as_if_changed(monkeypatch, file):
    """Let a file of the project count as one with another line of code."""
    code, changed = sources._code, (sources.ROOT / file).read_text(encoding="utf-8")
    monkeypatch.setattr(sources, "_code", lambda text: code(text + "WIDER = 2.0\n" if text == changed else text))


@pytest.fixture
def root(tmp_path):
    package = tmp_path / "simulation"
    (package / "objects").mkdir(parents=True)
    (package / "arm.py").write_text("from simulation import solver\n")
    (package / "solver.py").write_text('"""Solves."""\nSTEPS = 3\n')
    (package / "report.py").write_text("WIDTH = 80\n")
    (package / "objects" / "circle.toml").write_text("mass_kg = 0.1\n")
    return tmp_path


@pytest.mark.parametrize(
    ("file", "text", "counts"),
    [
        ("solver.py", '"""Solves."""\nSTEPS = 4\n', True),
        ("objects/circle.toml", "mass_kg = 0.2\n", True),
        ("solver.py", '"""Solves well."""\nSTEPS = 3  # enough\n', False),
        ("report.py", "WIDTH = 81\n", False),
    ],
)
def test_a_result_is_known_by_all_that_computed_it_and_by_nothing_else(root, file, text, counts):
    before = sources_sha256("simulation.arm", root)
    (root / "simulation" / file).write_text(text)
    assert (sources_sha256("simulation.arm", root) != before) == counts


def test_an_insertion_is_played_by_the_solver_the_service_and_the_client():
    played = {
        str(path.relative_to(sources.ROOT)) for path in sources._closure("simulation.closed_loop.play", sources.ROOT)
    }
    wanted = {
        "simulation/physics/kernels/newton.py",
        "service/decision/belief.py",
        "service/perception/slip/detector.py",
        "robot_client/insertion/machine.py",
    }
    assert wanted <= played
    assert "simulation/closed_loop/report.py" not in played
