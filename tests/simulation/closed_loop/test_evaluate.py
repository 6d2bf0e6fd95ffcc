"""The lock-step loop with the real session and the real machine; the networks are tiny, so only the loop is judged."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from service.decision.models import load_models
from simulation.closed_loop.job import Job
from simulation.closed_loop.lockstep import LockstepCell
from simulation.closed_loop.play import insert, stage
from simulation.scene.worlds import load_scene

RELEASED = Path(__file__).parents[3] / "models"


def job(scene="rectangle", x_mm=8.0, theta_deg=0.0, seed=1, controller="oracle", **more):
    return Job(scene, 0, x_mm, theta_deg, seed, controller, **more)


def test_an_object_above_its_gap_goes_in_at_once(models):
    row = insert(job(x_mm=0.0, controller="heuristic"), models)
    assert row["inserted"]
    assert row["attempts"] == 1
    assert row["course"]["block_mm"] < 0.5


def test_a_blocked_object_is_stopped_by_slip_and_inserted_by_a_true_correction(models):
    row = insert(job(), models)
    assert row["inserted"], row["reason"]
    assert 2 <= row["attempts"] <= 3
    first = row["trials"][0]
    assert first["decision"]["type"] == "correction"
    assert first["error_before"][0] == pytest.approx(8.0, abs=0.5)
    assert first["decision"]["dx_mm"] == pytest.approx(-8.0, abs=0.5)


@pytest.mark.parametrize(
    "changes",
    [
        pytest.param({"gel.tier": "layer", "gel.friction": 0.56}, marks=pytest.mark.slow),
        {"gel.shear_modulus_n_per_mm2": 0.24},
    ],
)
def test_an_object_that_slid_up_in_the_hand_without_a_slip_message_is_not_claimed(models, changes):
    """Yawed above the gap's middle it stands on both blocks: the whole patch slides straight up at once."""
    slides = job(x_mm=0.0, theta_deg=8.0, controller="heuristic", perception="fields", changes=changes)
    play = stage(slides, models)
    ended = play.run()
    assert not play.cell.state.inserted, "this start no longer shows it: look for another one"
    assert not ended.claimed
    assert "not_confirmed: full depth was reached, but " in ended.reason
    assert "the gels still carry a push" in ended.reason


def test_nothing_is_claimed_of_an_object_that_left_the_simulated_grasp(models):
    """The gels' view of it is unknown: the insertion is void, not inserted and not a false claim."""
    play = stage(job(), models)
    play.cell.physics.grasp_lost = True
    play.cell.state = play.cell.physics.look()
    ended = play.run()
    assert ended.void
    assert not ended.claimed
    assert "do not hold the object" in ended.reason


def test_the_blocks_are_free(models):
    assert stage(job("circle"), models).cell.physics.active.free_blocks


def test_the_same_seed_plays_the_same_insertion(models):
    first, second = (insert(job("circle", 6.0, 3.0, 5), models) for _ in range(2))
    assert first["final_error"] == second["final_error"]
    assert first["attempts"] == second["attempts"]


def test_drawing_late_gives_the_bits_of_drawing_now():
    now, late = (LockstepCell.build(load_scene("circle"), 6.0, 3.0, 4, draws=draws) for draws in (True, False))
    for cell in (now, late):
        cell.descend(0.0)
    for _ in range(18):
        pair = now.next_pair()
        late.next_pair()
    assert np.array_equal(pair.left.pixels, late.picture_later(0)())
    assert np.array_equal(pair.right.pixels, late.picture_later(1)())


def test_dropped_frames_still_end_in_an_answer(models):
    play = stage(job(changes={"camera.dropped_share": 0.2}), models)
    assert play.run().inserted
    assert not all(all(play.cell.arrived()) for play.cell.frame in range(50))


def test_a_row_says_which_job_it_came_from(models):
    asked = job("circle", 0.0, condition="layer: as trained", changes={"gel.tier": "layer"})
    assert insert(asked, models).items() >= dataclasses.asdict(asked).items()


@pytest.mark.slow
def test_a_contact_that_is_about_to_leave_an_edge_settles_though_slowly() -> None:
    """Friction limits there need 600 to 900 damped rounds; given 300, this insertion ended without an equilibrium."""
    row = insert(Job("can", 0, 15.0, 15.0, 0, "belief", "fields"), load_models(RELEASED))
    assert not row["void"], row["reason"]
    assert row["inserted"]
