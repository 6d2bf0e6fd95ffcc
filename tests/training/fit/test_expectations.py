"""The belief's expectations are the ones planted in logs of insertions, and those of the data."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.contract import ContractError
from service.contract.model_card import Expectations
from service.decision.belief import BeliefGrid
from training.fit.expectations import of_errors, of_insertions

USUAL = Expectations()


def log_of(path, far_mm, near_mm, per_mm, rng, count=400, played_by=()):
    """Insertions of two attempts whose object crept outwards by a given amount, a few of them far more.

    A new grasp follows each. ``played_by``: controller and code of the first ones.
    """
    with path.open("w") as file:
        for number in range(count):
            height_mm, x_mm = float(rng.uniform(30, 90)), float(rng.uniform(-14, 14))
            move = float(rng.uniform(-5, 5))
            crept = near_mm + per_mm * (height_mm - 30) if abs(x_mm) < USUAL.near_mm else far_mm
            crept += float(rng.normal(0, 0.2)) + (8.0 if rng.random() < 0.05 else 0.0)
            stays, far_off_mm = {"dx_mm": 0.0, "dtheta_deg": 0.0}, float(rng.uniform(-14, 14))
            trials = [
                {"error_before": [x_mm, 1.0], "decision": {"attempt": 3, "dx_mm": move, "dtheta_deg": -0.5}},
                {"error_before": [x_mm + move + np.sign(x_mm) * crept, 0.5], "decision": {"attempt": 4} | stays},
                {"error_before": [far_off_mm, 9.0], "decision": {"attempt": 1} | stays},
            ]
            controller, made_by = played_by[number] if number < len(played_by) else ("belief", "aa")
            row = {"grasp_height_mm": height_mm, "controller": controller, "made_by": made_by, "trials": trials}
            file.write(json.dumps(row) + "\n")
    return path


@settings(deadline=None, max_examples=15)
@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.floats(0.0, 0.03), st.integers(0, 2**20))
def test_planted_creep_is_found(tmp_path_factory, far_mm, near_mm, per_mm, seed):
    path = log_of(tmp_path_factory.mktemp("log") / "log.jsonl", far_mm, near_mm, per_mm, np.random.default_rng(seed))
    expected = of_insertions([path], USUAL)
    assert expected.creep_mm == pytest.approx(far_mm, abs=0.1)
    assert expected.creep_near_mm == pytest.approx(near_mm, abs=0.15)
    assert expected.creep_near_mm_per_mm == pytest.approx(per_mm, abs=0.004)
    assert 0.1 <= expected.creep_spread_mm < 0.4


@pytest.mark.parametrize("first", [("belief", "bb"), ("heuristic", "aa"), ("oracle", "aa")])
def test_the_creep_of_several_networks_or_controllers_is_not_mixed_and_an_oracles_is_none(tmp_path, first):
    log = log_of(tmp_path / "log.jsonl", 0.5, 0.2, 0.0, np.random.default_rng(1), played_by=[first])
    with pytest.raises(ContractError, match=rf"holds insertions of .*{first[0]} \({first[1]}\)"):
        of_insertions([log], USUAL)
    alone = log_of(tmp_path / "alone.jsonl", 0.5, 0.2, 0.0, np.random.default_rng(1), 50, [("oracle", "aa")] * 50)
    with pytest.raises(ContractError, match="no oracle"):
        of_insertions([alone], USUAL)


def test_a_creep_that_no_belief_can_expect_is_refused(tmp_path):
    log = log_of(tmp_path / "log.jsonl", 40.0, 40.0, 0.0, np.random.default_rng(1))
    with pytest.raises(ContractError, match="creep in these logs is none that a belief can expect: creep_mm"):
        of_insertions([log], USUAL)


def test_a_log_that_does_not_state_the_height_of_a_grasp_is_refused(tmp_path):
    log = log_of(tmp_path / "log.jsonl", 0.5, 0.2, 0.0, np.random.default_rng(1))
    log.write_text(log.read_text().replace("grasp_height_mm", "changes"))
    with pytest.raises(ContractError, match="grasp_height_mm"):
        of_insertions([log], USUAL)


def test_a_line_that_a_kill_truncated_is_left_out(tmp_path):
    log = log_of(tmp_path / "log.jsonl", 0.5, 0.2, 0.0, np.random.default_rng(1))
    whole = of_insertions([log], USUAL)
    first, *others = log.read_text().splitlines(keepends=True)
    log.write_text(first + first[:40] + "\n" + "".join(others))
    assert of_insertions([log], USUAL) == whole


def test_too_few_attempts_and_a_foreign_file_are_refused(tmp_path):
    with pytest.raises(ContractError, match="expected at least"):
        of_insertions([log_of(tmp_path / "few.jsonl", 0.3, 0.3, 0.0, np.random.default_rng(0), count=5)], USUAL)
    for other in (b"no json\n", b"\xff\xfe\x00", b'{"trials": [{}, {}]}\n', b'{"trials": 5, "changes": {}}\n'):
        (tmp_path / "other.jsonl").write_bytes(other)
        with pytest.raises(ContractError, match=r"\.insertions\.jsonl of an evaluation"):
            of_insertions([tmp_path / "other.jsonl"], USUAL)


def test_prior_and_spread_follow_the_data():
    expected = of_errors(np.random.default_rng(0).uniform(-10, 10, (4000, 2)), USUAL)
    assert expected.edge == pytest.approx((12, 12), abs=0.1)
    assert expected.spread == pytest.approx((10 / 3**0.5,) * 2, rel=0.05)
    assert expected.creep_mm == USUAL.creep_mm


def test_a_belief_moves_as_far_as_its_card_says():
    still, creeping = (BeliefGrid(45.0, Expectations(creep_mm=far, creep_near_mm=far)) for far in (0.0, 2.0))
    for grid in (still, creeping):
        grid.layers[..., :60, :] = 0.0  # the error is beyond 8 mm
        grid.layers /= grid.layers.sum()
        grid.creep()
    (still_mm, _), (creeping_mm, _) = (grid.moments()[0] for grid in (still, creeping))
    assert creeping_mm - still_mm == pytest.approx(2.0, abs=0.1)
