"""The stop report's arithmetic; the runs behind it are those of `python -m simulation run`."""

import json
from types import SimpleNamespace

import pytest

from simulation.__main__ import main
from simulation.stop_report import WAYS, row, stops_of, table


def test_stops_of_all_insertions_are_put_together_and_held_against_the_frame(tmp_path):
    log = tmp_path / "episode.jsonl"
    rows = [{"overtravel_mm": mm, "slip_age_ms": ms} for mm, ms in ((0.2, 9.0), (None, None), (0.3, 11.0))]
    log.write_text(json.dumps({"plan": {}}) + "\n" + json.dumps({"end": {"rows": rows}}) + "\n")
    results = [SimpleNamespace(frozen_ms=(10.0, 40.0), rest_ms=(100.0, 140.0))]
    line = row(WAYS[0], stops_of(results, [log]), 30)
    assert line == "| EGM, lag 20 ms | 10 (11) | 25 (40) | 1 of 2 | 120 (140) | 0.25 (0.30) |"
    assert line in table([line], 30)


def test_no_stop_is_no_number():
    assert "- | - | 0 of 0 | - | -" in row(WAYS[1], stops_of([], []), 30)


@pytest.mark.parametrize("wrong", [["--repeat", "0"], ["--models", "/nonexistent"], ["--object", "no such"]])
def test_wrong_input_is_refused_before_anything_starts(wrong):
    assert main(["stop-report", *wrong]) == 2
