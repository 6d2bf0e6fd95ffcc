import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulation.closed_loop import benchmark, statistics
from simulation.closed_loop.job import Job, job_in
from simulation.closed_loop.play import insert
from simulation.scene.worlds import World, load_objects, load_scene

COURSE = {"block_mm": 0.2, "force_n": 9.0}
DECISION = {
    "type": "correction",
    "class_probabilities": {"5": 0.8, "6": 0.2},
    "estimate": {"dx_mm": 4.0, "dtheta_deg": 7.0, "interval_x_mm": [4.5, 6.0], "interval_theta_deg": [6.0, 7.5]},
}
ROW = {
    "scene": "rectangle",
    "controller": "belief",
    "index": 0,
    "seed": 0,
    "perception": "pictures",
    "condition": "",
    "inserted": True,
    "claimed": True,
    "void": False,
    "attempts": 3,
    "reason": "",
    "grasp_kept": True,
    "course": COURSE,
    "x_mm": 5.0,
    "theta_deg": -3.0,
    "trials": [{"error_before": [5.0, 8.0], "decision": DECISION}],
}


def test_a_failure_counts_as_sixteen_trials():
    ends = statistics.ends([ROW, ROW | {"inserted": False, "claimed": False, "attempts": 15}])
    assert ends["mean_trials"] == pytest.approx((3 + 16) / 2)
    assert (ends["inserted"], ends["insertions"], ends["refused"]) == (1, 2, 0)


def test_an_insertion_that_is_only_claimed_is_none():
    ends = statistics.ends([ROW | {"inserted": False}])
    assert (ends["inserted"], ends["claimed_wrongly"]) == (0, 1)


def test_an_insertion_without_an_equilibrium_is_not_said_to_be_refused():
    failed = ROW | {"inserted": False, "claimed": False}
    ends = statistics.ends([failed | {"attempts": 2, "void": True}, failed | {"attempts": 1}])
    assert (ends["void"], ends["refused"]) == (1, 1)


@pytest.mark.parametrize(
    ("reason", "named"),
    [
        ("service: refused: untrained: grip_n is 9, trained on 9.4 to 43", "service: refused: untrained: grip_n"),
        (
            "service: no_decision: out_of_distribution: speed_mm_s is 2, the networks were trained on 2.9 to 41",
            "service: no_decision: out_of_distribution: speed_mm_s",
        ),
        (
            "service: no_decision: out_of_distribution: is a camera mirrored? (strangeness 6.2, at most 5.0)",
            "service: no_decision: out_of_distribution: is a camera mirrored?",
        ),
        ("service: no_decision: no_motion: no marker moved by 0.05 mm", "service: no_decision: no_motion"),
        ("limits: plan: plan z_mm = 0.0, allowed 5 .. 150", "limits: plan: plan z_mm = 0.0, allowed 5 .. 150"),
        ("service: unwatched: newest frame judged 403 ms ago", "service: unwatched"),
        (
            "commissioning: contradictory: the fingers are swapped",
            "commissioning: contradictory: the fingers are swapped",
        ),
    ],
)
def test_a_row_names_what_was_refused_and_no_figures(reason, named):
    failed = ROW | {"inserted": False, "claimed": False, "reason": reason, "object": "rectangle", "condition": "a"}
    (row,) = benchmark.table([failed])
    assert row["reasons"] == {named: 1}


def test_a_row_names_why_the_physics_failed(models):
    soft = World("soft", {"gel.thickness_mm": 10.0, "gel.shear_modulus_n_per_mm2": 0.005})
    (row,) = benchmark.table([insert(Job(**job_in(soft, "circle", 0, (5.0, 3.0), 1)), models)])
    assert (row["void"], row["reasons"]) == (1, {"physics: gel squeezed through": 1})


def test_starts_are_uniform_in_the_range_of_the_object_and_repeat_by_seed():
    scene = load_scene("rectangle")
    starts = benchmark.drawn_starts(scene, 30, 7)
    assert all(abs(x) <= scene.x_range_mm and abs(theta) <= scene.theta_range_deg for x, theta in starts)
    assert benchmark.drawn_starts(scene, 5, 7) == starts[:5] != benchmark.drawn_starts(scene, 5, 8)


def test_an_object_has_the_same_starts_in_every_world_but_no_two_insertions_share_a_grasp(tmp_path):
    objects, worlds = load_objects(["circle", "can"]), [World("one"), World("other")]
    jobs = [
        task.job for seed in (0, 1) for task in benchmark.tasks(worlds, objects, 3, seed, tmp_path, "code")
    ]  # of neighbouring seeds, whose objects have neighbouring numbers
    assert len({job["seed"] for job in jobs}) == len(jobs) == 24
    starts = {(job["scene"], job["index"], job["x_mm"] / objects[job["scene"]].x_range_mm) for job in jobs}
    assert len({share for _, _, share in starts}) == len(starts) == 12


@given(st.floats(-20, 20), st.floats(-20, 20))
def test_every_error_has_one_class(x, theta):
    mirror = {"1": "2", "2": "1", "3": "6", "6": "3", "4": "5", "5": "4", "7": "8", "8": "7", "near": "near"}
    assert mirror[statistics.class_of(x, theta)] == statistics.class_of(-x, -theta)


def test_first_answers_are_judged_against_the_truth():
    answers = benchmark.first_answers([ROW])
    assert (answers["direction_right"], answers["direction_n"]) == (1, 1)
    assert (answers["mae_x_mm"], answers["mae_theta_deg"]) == (1.0, 1.0)
    assert (answers["covered_x"], answers["covered_theta"]) == (1.0, 0.0)


def test_an_oracle_gives_no_answers_to_judge():
    step = DECISION | {"class_probabilities": {}}
    answers = benchmark.first_answers([ROW | {"trials": [{"error_before": [5.0, 8.0], "decision": step}]}])
    assert (answers["direction_n"], answers["mae_x_mm"], answers["covered_x"]) == (0, None, None)


def test_an_object_whose_file_is_gone_keeps_its_row(tmp_path):
    rows = benchmark.table([ROW, ROW | {"scene": str(tmp_path / "gone.toml")}])
    assert [row["object"] for row in rows] == ["rectangle", "gone"]
