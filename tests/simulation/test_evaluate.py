"""The lock-step loop with the real session and the real machine; the networks are tiny, so only the loop is judged."""

import pytest

from service.models import load_models
from simulation.evaluate import Insertion, Job, insert, oracle_step
from simulation.lockstep import LockstepCell
from simulation.scene import load_scene
from tests.service import tiny_models


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    return load_models(tiny_models.write_models(tmp_path_factory.mktemp("models") / "tiny"))


def test_an_object_above_its_gap_goes_in_at_once(models):
    outcome = insert(Job("rectangle", 0, 0.0, 0.0, 1, "heuristic", "none"), models)
    assert outcome.inserted
    assert outcome.attempts == 1
    assert outcome.block_motion_mm < 0.5


def test_a_blocked_object_is_stopped_by_slip_and_inserted_by_a_true_correction(models):
    world = LockstepCell.build(load_scene("rectangle"), 8.0, 0.0, 1)
    outcome = Insertion(world, models, "heuristic", oracle_step).run()
    assert outcome.inserted, outcome.reason
    assert 2 <= outcome.attempts <= 4
    assert outcome.trials[0]["decision"]["type"] == "correction"
    assert outcome.trials[0]["error_before"][0] == pytest.approx(8.0, abs=0.5)


def test_the_same_seed_plays_the_same_insertion(models):
    job = Job("circle", 0, 6.0, 3.0, 5, "heuristic", "oracle")
    first, second = insert(job, models), insert(job, models)
    assert first.final_error == second.final_error
    assert first.attempts == second.attempts
