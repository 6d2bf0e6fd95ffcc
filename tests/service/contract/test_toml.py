"""Files that are no TOML, in every way that a file can be none."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_client.settings import load_settings
from service.contract.toml import parse_toml, read_toml, toml_text
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


TEXT = st.text(st.characters(exclude_categories=["Cs"]))
SCALARS = st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | TEXT
VALUES = st.recursive(SCALARS, lambda below: st.lists(below, max_size=3) | st.dictionaries(TEXT, below, max_size=3))


@given(st.dictionaries(TEXT, VALUES, max_size=5))
def test_what_is_written_is_read_again(tables: dict[str, Any]) -> None:
    assert parse_toml(toml_text(tables).encode(), "it") == tables


def test_a_list_of_tables_has_a_line_for_each_and_what_is_none_is_left_out() -> None:
    text = toml_text({"probes": ({"x_mm": 8.0, "said": None}, {"x_mm": -8.0}), "seed": None, "gels": {"left": "a"}})
    assert text == 'probes = [\n  {x_mm = 8.0},\n  {x_mm = -8.0},\n]\n\n[gels]\nleft = "a"\n'


def test_a_number_of_numpy_is_a_number_and_what_toml_cannot_hold_is_refused() -> None:
    assert toml_text({"x_mm": np.float64(0.1)}) == "x_mm = 0.1\n"
    with pytest.raises(TypeError, match="no TOML for"):
        toml_text({"begun": object()})
