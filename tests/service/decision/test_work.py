"""What keeps the networks from deciding is an answer, not an error of the thread that asks them."""

from types import SimpleNamespace

import pytest

from service.contract import MarkerSpec, wire
from service.decision.attempt import Attempt
from service.decision.work import plan_work
from service.perception.markers.field import empty_field
from tests.service import tiny_models


@pytest.mark.parametrize("referenced", [False, True])
def test_a_grid_that_is_not_the_networks_is_refused_as_any_other_stranger(*, referenced: bool) -> None:
    lattice = MarkerSpec(rows=20, columns=21, pitch_px=15.0, first_px=(13.0, 17.0))
    models = SimpleNamespace(card=tiny_models.card("direction", "step", markers=lattice))
    arm = wire.Arm(insertion_id="one", attempt=3, gap_width_mm=56.0, expected_depth_mm=25.0)
    attempt = Attempt(arm, 0, generation=7)
    finger = SimpleNamespace(field=empty_field(0, "no_grid", "no markers"))
    pair = SimpleNamespace(fingers=(finger, finger))
    attempt.decision_pairs = [pair]
    attempt.network_reference = pair if referenced else None
    result = plan_work(models, attempt, pair).run()
    assert result is not None
    assert (result.attempt, result.generation, result.evidence) == (3, 7, None)
    assert result.refusal is not None
    assert result.refusal.reason == "out_of_distribution"
