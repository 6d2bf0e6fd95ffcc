"""The stop report's arithmetic; the runs behind it are those of `python -m simulation run`."""

import json

import pytest

from simulation.__main__ import main
from simulation.studies.stop_latency import WAYS, Stops, stop_page

MS = 1_000_000


def slip(attempt, captured_ms):
    return {
        "event": {"message": {"type": "slip", "attempt": attempt, "finger": "left", "captured_ns": captured_ms * MS}}
    }


def test_a_stop_counts_from_the_sending_of_the_frame_that_shows_slip(tmp_path):
    log = tmp_path / "episode.jsonl"
    rows = [{"overtravel_mm": 0.2}, {"overtravel_mm": None}, {"overtravel_mm": 0.3}]
    entries = [{"plan": {}}, slip(1, 100), slip(1, 133), slip(2, 900), slip(3, 2000), {"end": {"rows": rows}}]
    log.write_text("\n".join(map(json.dumps, entries)))
    sent = [[100 * MS, 120 * MS], [900 * MS, 910 * MS]]
    stops = [{"frozen_ns": 130 * MS, "rest_ns": 250 * MS}, {"frozen_ns": 950 * MS, "rest_ns": 1000 * MS}]
    together = Stops()
    together.add(log, {"frames_sent_ns": {"left": sent}, "stops": stops})
    assert (together.drawn_ms, together.frozen_ms, together.rest_ms) == ([20.0, 10.0], [10.0, 40.0], [130.0, 90.0])
    line = "| EGM, lag 20 ms | 25 (40) | 1 of 2 | 110 (130) | 0.25 (0.30) | 15 (20) |"
    assert line in stop_page([(WAYS[0], together)], 30)


def test_no_stop_is_no_number():
    assert "| - | 0 of 0 | - | - | - |" in stop_page([(WAYS[1], Stops())], 30)


@pytest.mark.parametrize("wrong", [["--repeat", "0"], ["--models", "/nonexistent"], ["--object", "no such"]])
def test_wrong_input_is_refused_before_anything_starts(wrong):
    assert main(["stop-report", *wrong]) == 2
