import os
import subprocess
import sys
from pathlib import Path

import pytest

from simulation.compile_cache import VARIABLE, keep_apart, make, state_of

CALLEE = "from numba import njit\n\n@njit(cache=True)\ndef number():\n    return {value}\n"
CALLER = """from numba import njit
from small.callee import number

@njit(cache=True)
def twice():
    return 2 * number()
"""


@pytest.fixture
def small(tmp_path):
    package = tmp_path / "small"
    package.mkdir()
    (package / "__init__.py").write_text(
        "from pathlib import Path\nfrom simulation.compile_cache import keep_apart\nkeep_apart(Path(__file__).parent)\n"
    )
    (package / "callee.py").write_text(CALLEE.format(value=1))
    (package / "caller.py").write_text(CALLER)
    (package / "other.py").write_text("")
    return package


def test_only_what_is_compiled_moves_the_cache(small):
    first = state_of(small)
    (small / "other.py").write_text("VALUE = 1\n")
    assert state_of(small) == first
    (small / "callee.py").write_text(CALLEE.format(value=2))
    assert state_of(small) != first


def test_a_folder_that_the_environment_names_holds_the_states_apart_too(small, monkeypatch):
    monkeypatch.setenv(VARIABLE, "/var/lib/cache")
    for _ in range(2):  # a child process is told once more
        keep_apart(small)
        assert os.environ[VARIABLE] == f"/var/lib/cache/{state_of(small)}"


def test_an_installation_of_somebody_else_keeps_its_states_apart_in_the_users_cache(small, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, _: small not in (path, *path.parents))  # a superuser may write
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv(VARIABLE, raising=False)
    make(small)
    assert os.environ[VARIABLE] == str(tmp_path / "cache" / "tactile-insertion" / state_of(small))
    assert Path(os.environ[VARIABLE]).is_dir()


def test_where_nothing_compiled_can_be_kept_a_command_says_what_to_name(tmp_path):
    (tmp_path / "file").touch()
    folder = tmp_path / "file" / "cache"
    command = [sys.executable, "-m", "simulation", "explain", "rectangle"]
    done = subprocess.run(
        command, env=os.environ | {VARIABLE: str(folder)}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"explain: cannot keep the compiled physics in {folder}")
    assert VARIABLE in line


def test_a_caller_does_not_go_on_with_what_its_callee_was_before(small, monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setenv("PYTHONPATH", f"{small.parent}:{Path(__file__).parents[3]}")
    # numba is told by the first package that is imported, so the small one stands for ours
    code = "import os, sys; sys.modules['simulation'] = type(sys)('simulation'); "
    code += f"sys.modules['simulation'].__path__ = [{str(Path(__file__).parents[3] / 'simulation')!r}]; "
    code += "from small.caller import twice; print(twice())"

    def printed() -> str:
        return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()

    assert printed() == "2"
    (small / "callee.py").write_text(CALLEE.format(value=21))
    assert printed() == "42"
