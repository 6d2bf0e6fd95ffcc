"""Faults during a descent that would fit: their claims, and how they are counted."""

import json
from dataclasses import replace

import pytest

from reporting.statistics import wilson
from simulation.__main__ import main
from simulation.closed_loop.job import Job
from simulation.closed_loop.play import insert
from simulation.scene import drawn
from simulation.scene.worlds import load_objects
from simulation.studies import trust
from tests.service import tiny_models


def fits(**fault: object) -> Job:
    """An insertion that goes in at once, with a fault in its descent."""
    given = {"fingers": ("left", "right"), "attempt": 1, "depth_mm": 8.0, **fault} if fault else {}
    return Job("circle", 0, 0.3, 0.0, 3, "belief", perception="fields", fault=given)


def test_a_world_whose_lateness_is_unknown_is_not_played_and_its_folder_is_of_no_other(tmp_path, capsys):
    folder = tiny_models.write_models(tmp_path / "models")  # they decide nothing, so no press measures anything
    words = ["trust", "--out", str(tmp_path), "--docs", str(tmp_path), "--models", str(folder), "-j", "1"]
    words += ["--objects", "circle", "--count", "1", "--drawn-n", "1", "--layer-share", "0"]
    for seed, why in ((1, "lateness was measured: nothing to play"), (2, "of other worlds, objects, seed or timing")):
        assert main([*words, "--seed", str(seed)]) == 2
        assert why in capsys.readouterr().err


def test_without_a_fault_it_is_claimed_and_true(models):
    row = insert(fits(), models)
    assert (row["claimed"], row["inserted"], row["in_gap"]) == (True, True, True)


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ({"kind": "dropped"}, "part_lost"),
        ({"kind": "dropped", "depth_mm": -1.0}, "nothing_held"),
        ({"kind": "frozen"}, "unwatched"),
        ({"kind": "frozen", "fingers": ("right",)}, "unwatched"),
        ({"kind": "dark"}, "unwatched"),
        ({"kind": "stuck"}, "unwatched"),
        ({"kind": "stuck", "fingers": ("left",)}, "unwatched"),
    ],
)
def test_a_hand_that_is_empty_or_eyes_that_are_blind_claim_nothing(models, fault, says):
    row = insert(fits(**fault), models)
    assert row["fault_acted"]
    assert not row["claimed"]
    assert says in row["reason"]
    assert says == "nothing_held" or 0.0 < row["unseen_mm"] <= row["unseen_allowed_mm"]
    if fault["kind"] == "dropped":
        assert not row["in_gap"], "the mechanics still hold it, the hand does not"


@pytest.mark.parametrize("fps", [11.0, 30.0])
def test_frames_that_freeze_leave_no_more_travel_than_the_lease_allows_at_any_rate(models, fps):
    changes = {"camera.fps": fps, "camera.latency_ms": 50.0, "speed_mm_s": 5.0}
    job = replace(fits(kind="frozen"), changes=changes, unstated={"stop_lag_s": 0.03})
    known, unknown = (insert(replace(job, late_s=late_s), models)["unseen_mm"] for late_s in (0.08, None))
    assert 1.4 < known <= 1.5 + 1e-6
    assert unknown == pytest.approx(known + 5.0 * 0.04, abs=0.01), "40 ms are reckoned with, it is 80 ms late"


def test_the_draw_is_the_same_for_the_same_seed_and_holds_every_kind(tmp_path):
    worlds = [drawn.world(tables, str(number)) for number, tables in enumerate(drawn.draw_worlds(5, 2))]
    objects = load_objects(["circle", "can"])
    first, again = (trust.tasks(worlds, objects, 400, 4, tmp_path, {}) for _ in range(2))
    assert first == again
    kinds = {task.job["fault"]["kind"] for task in first if "fault" in task.job}
    assert kinds == set(trust.KINDS)
    assert {task.job["condition"].partition(": ")[2] for task in first} > {trust.WITHOUT, *trust.MISTAKES}
    assert all(task.made(json.loads(json.dumps(task.job))) for task in first), "what is in the log is not played again"
    assert trust.tasks(worlds, objects, 200, 5, tmp_path, {}) != first
    late = {"0": 0.08, "1": None}
    timed = {
        task.job["condition"].partition(": ")[0]: task.job["late_s"]
        for task in trust.tasks(worlds, objects, 200, 4, tmp_path, late)
    }
    assert timed == {"0": 0.08, "2": None, "3": None, "4": None}, "where it cannot be measured, nothing is inserted"


def test_false_claims_come_first_on_the_page_and_void_ones_count_as_neither():
    row = {"fault": {}, "reason": "", "claimed": True, "inserted": True, "in_gap": True, "void": False}
    row |= {"condition": "w: no fault", "scene": "can", "index": 1, "seed": 7, "shortfalls": ()}
    row |= {"unseen_mm": 1.2, "unseen_allowed_mm": 1.5}
    faulty = {"fault": {"kind": "stuck"}, "condition": "w: stuck, left", "fault_acted": True}
    rows = [row] * 96 + [row | faulty | {"fault_acted": False}]
    rows += [row | faulty | {"inserted": False, "in_gap": False, "shortfalls": ("it is tilted",), "unseen_mm": 3.0}]
    rows += [row | {"claimed": False, "inserted": False, "reason": "service: not_confirmed: full depth"}]
    rows += [row | {"claimed": False, "inserted": False, "in_gap": False, "void": True, "reason": "physics: x"}]
    late = [{"world": "w", "late_s": late_s, "true_late_s": 0.08, "robot_s": 30.0} for late_s in (0.07, 0.1, None)]
    data = trust.report_of(rows, late, {})
    assert data["all"] == {
        "insertions": 100,
        "claimed": 98,
        "claimed_wrongly": 1,
        "inserted": 97,
        "good_refused": 1,
        "void": 1,
        "unseen_mm": 3.0,
        "unseen_share": 2.0,
    }
    assert {group["fault"]: group["insertions"] for group in data["faults"]} == {
        "no fault": 98,
        "stuck, left": 1,
        "fault that never came about": 1,
    }
    text = trust.trust_page(data)
    prose = text.replace("\n", " ")
    assert "the lateness of pictures and arm in 2 of 3 worlds, +5 ms from the truth on average, -10 to +20 ms;" in prose
    assert f"**1 of 98 claims were false: {wilson(1, 98):.2%}**. That is 1.00 % (0.18 .. 5.45) of 100" in prose
    assert "Without a fault, 97 insertions ended in the gap, and 1 of those were not claimed" in prose
    assert "| w: stuck, left | can | 7 | it is tilted |" in text


@pytest.mark.parametrize("knows", [True, False])
def test_a_client_that_knows_how_late_its_cell_is_keeps_the_bound_and_another_does_not(models, knows):
    """Frames that freeze, in a cell whose pictures and arm are late by 165 ms together."""
    late = {"camera.latency_ms": 90.0, "camera.fps": 60.0, "speed_mm_s": 10.0}
    job = replace(fits(kind="frozen"), changes=late, unstated={"stop_lag_s": 0.075}, late_s=0.165 if knows else None)
    row = insert(job, models)
    assert "unwatched" in row["reason"]
    assert (row["unseen_mm"] <= row["unseen_allowed_mm"] + 0.01) == knows
