"""The token of a service: made once, for its owner alone, and never taken from a file that others could write."""

import shutil
import stat
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from service.contract.token import TokenError, check_token, keep_token, read_token


def test_a_token_is_made_once_and_for_its_owner_alone(tmp_path: Path) -> None:
    token, path = keep_token(tmp_path / "new" / "state")
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
    assert len(token) >= 40
    assert keep_token(path.parent) == (token, path)
    assert read_token(path) == token
    assert sorted(path.parent.iterdir()) == [path]


def test_services_that_start_at_one_moment_agree(tmp_path: Path) -> None:
    with ThreadPoolExecutor(16) as pool:
        assert len(set(pool.map(lambda _: keep_token(tmp_path / "together")[0], range(64)))) == 1


def test_a_file_that_others_can_read_or_that_leads_elsewhere_is_refused(tmp_path: Path) -> None:
    _, path = keep_token(tmp_path)
    for mode in (0o640, 0o604, 0o660):
        path.chmod(mode)
        with pytest.raises(TokenError, match="nobody else may read"):
            keep_token(tmp_path)
    elsewhere = path.rename(tmp_path / "elsewhere")
    elsewhere.chmod(0o600)
    path.symlink_to(elsewhere)
    with pytest.raises(TokenError, match="nobody else may read"):
        keep_token(tmp_path)


@pytest.mark.parametrize("content", ["", "\n", "short", "\x00" * 40])
def test_a_file_without_a_token_is_refused(tmp_path: Path, content: str) -> None:
    _, path = keep_token(tmp_path)
    path.write_text(content)
    with pytest.raises(TokenError, match=r"token file .* needs 16 or more"):
        keep_token(tmp_path)


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(TokenError, match="name a folder of yours with --state"):
        keep_token(tmp_path / "file")


def test_a_token_needs_sixteen_characters() -> None:
    assert check_token("x" * 16) == "x" * 16
    with pytest.raises(TokenError):
        check_token("x" * 15)


def test_a_user_without_a_home_is_asked_for_a_folder() -> None:
    nobody = [shutil.which("unshare") or "unshare", "--user", "--map-user=54321"]
    try:
        subprocess.run([*nobody, "true"], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("this machine lets no user be one without a name")
    command = [*nobody, sys.executable, "-c", "from service.contract.token import state_folder; state_folder()"]
    environment = {"PYTHONPATH": str(Path(__file__).parents[3])}
    ended = subprocess.run(command, check=False, env=environment, capture_output=True, text=True)
    assert "TokenError: this user has no home for the state folder; name a folder in TACTILE_STATE" in ended.stderr
