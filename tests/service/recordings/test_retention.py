"""What goes when the recordings outgrow their limit, and what stays to be learnt from."""

import json
from collections.abc import Sequence
from pathlib import Path

import pytest

from service.recordings.retention import prune

SIZE = 1000


def recorded(root: Path, number: int, summary: object = None) -> Path:
    folder = root / f"20260101T{number:06}_r{number}"
    folder.mkdir()
    text = json.dumps({"purpose": "insertion"} if summary is None else summary)
    (folder / "summary.json").write_text(text)
    (folder / "insertion.mcap").write_bytes(b"\0" * (SIZE - len(text)))
    return folder


def left(root: Path) -> Sequence[int]:
    return sorted(int(path.name.rpartition("r")[2]) for path in root.iterdir())


@pytest.mark.parametrize(("probes_n", "kept"), [(3, [0, 1, 2, 15, 16, 17, 18, 19]), (10, [6, 7, 8, 9, 16, 17, 18, 19])])
def test_the_newest_probes_outlive_the_work_that_follows_and_fill_half_of_the_space(
    tmp_path: Path, probes_n: int, kept: list[int]
) -> None:
    for number in range(20):
        recorded(tmp_path, number, {"purpose": "probe"} if number < probes_n else None)
        prune(tmp_path, 8 * SIZE)
    assert left(tmp_path) == kept


@pytest.mark.parametrize("summary", [[], "probe", {"purpose": ["probe"]}, {}])
def test_only_what_says_that_it_is_a_probe_is_spared(tmp_path: Path, summary: object) -> None:
    for number in range(4):
        recorded(tmp_path, number, summary)
    (recorded(tmp_path, 4) / "summary.json").write_bytes(b"{\xff")
    prune(tmp_path, 2 * SIZE)
    assert left(tmp_path) == [3, 4]
