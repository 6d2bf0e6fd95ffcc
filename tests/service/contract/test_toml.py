"""Files that are no TOML, in every way that a file can be none."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from robot_client.settings import load_settings
from service.contract.toml import read_toml
from service.perception.rectification import Calibration
from service.settings import read_settings
from simulation.scene.worlds import load_scene
from training.config import RecipeConfig, RunConfig

NO_TOML = {
    "text": b"hello world\n",
    "bytes that are no UTF-8": b'\xff\xfe\x00name = "x"',
    "an integer of 6,000 digits": b"a = " + b"9" * 6000,
    "5,000 nested brackets": b"a = " + b"[" * 5000 + b"]" * 5000,
}
READERS: dict[str, Callable[[Path], Any]] = {
    "contract": read_toml,
    "robot client": load_settings,
    "calibration": Calibration.load,
    "service": lambda path: read_settings(["--config", str(path)]),
    "scene": load_scene,
    "training": RunConfig.load,
    "recipe": RecipeConfig.load,
}


@pytest.mark.parametrize("content", NO_TOML.values(), ids=NO_TOML.keys())
@pytest.mark.parametrize("read", READERS.values(), ids=READERS.keys())
def test_what_is_no_toml_is_refused_in_one_line_with_its_name(
    tmp_path: Path, read: Callable[[Path], Any], content: bytes
) -> None:
    path = tmp_path / "settings.toml"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"settings\.toml") as refused:
        read(path)
    assert len(str(refused.value).splitlines()) == 1


def test_a_byte_order_mark_and_windows_line_ends_are_ignored(tmp_path: Path) -> None:
    path = tmp_path / "settings.toml"
    path.write_bytes(b"\xef\xbb\xbf[gel]\r\nfriction = 0.5\r\n")
    assert read_toml(path) == {"gel": {"friction": 0.5}}


def test_a_file_that_is_not_there_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_toml(tmp_path / "none.toml")
