import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulation import evaluation
from simulation.cli.evaluate import main

ROW = {
    "scene": "rectangle",
    "controller": "belief",
    "baseline": "none",
    "inserted": True,
    "attempts": 3,
    "block_motion_mm": 0.2,
    "grasp_kept": True,
    "in_hand_mm": 1.0,
    "x_mm": 5.0,
    "theta_deg": -3.0,
}


def test_thirty_of_thirty_is_no_proof_of_certainty():
    low, high = evaluation.wilson(30, 30)
    assert low == pytest.approx(0.8865, abs=1e-3)
    assert high == 1.0


@given(st.integers(1, 500), st.data())
def test_the_interval_holds_the_share_and_mirrors(count, data):
    hits = data.draw(st.integers(0, count))
    low, high = evaluation.wilson(hits, count)
    assert 0.0 <= low <= hits / count + 1e-12
    assert hits / count - 1e-12 <= high <= 1.0
    assert evaluation.wilson(count - hits, count) == pytest.approx((1 - high, 1 - low))


def test_a_failure_counts_as_sixteen_trials():
    rows = [ROW, ROW | {"inserted": False, "attempts": 15}]
    (summary,) = evaluation.summarise(rows)
    assert summary["mean_trials"] == pytest.approx((3 + 16) / 2)
    assert summary["success"] == 0.5
    assert ">15" in evaluation.table([summary])


def test_the_table_says_whose_figures_are_simulated():
    text = evaluation.table(evaluation.summarise([ROW]))
    assert "inserted (simulated)" in text
    assert "real robot" in text
    assert "100 %, 4.7, 11" in text


def test_starts_are_the_four_extremes_then_uniform_and_repeat_by_seed():
    starts = evaluation.start_errors(30, 7)
    assert {(abs(x), abs(t)) for x, t in starts[:4]} == {(15.0, 15.0)}
    assert len({(math.copysign(1, x), math.copysign(1, t)) for x, t in starts[:4]}) == 4
    assert all(abs(x) <= 15.0 and abs(t) <= 15.0 for x, t in starts)
    assert starts == evaluation.start_errors(30, 7) != evaluation.start_errors(30, 8)


def test_an_unknown_object_or_models_folder_is_named(tmp_path):
    with pytest.raises(ValueError, match="teapot"):
        main(["--objects", "teapot", "--out", str(tmp_path)])
    with pytest.raises(ValueError, match="nowhere"):
        main(["--models", "nowhere", "--out", str(tmp_path)])


def test_a_finished_run_is_not_played_again(tmp_path, monkeypatch, capsys):
    models = tmp_path / "models"
    models.mkdir()
    done = []
    for index, (x, theta) in enumerate(evaluation.start_errors(2, 0)):
        done.append(ROW | {"index": index, "seed": index, "x_mm": x, "theta_deg": theta})
    log = tmp_path / "insertions.jsonl"
    log.write_text("\n".join(json.dumps(row) for row in done) + '\n{"cut by a ki')
    arguments = ["--objects", "rectangle", "--count", "2", "--out", str(tmp_path), "--models", str(models), "-j", "1"]
    assert main(arguments) == 0
    assert "2/2 = 100.0%" in capsys.readouterr().out
    assert (tmp_path / "trials.png").stat().st_size > 1000
