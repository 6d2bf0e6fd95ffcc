"""Four probes name wiring mistakes, and accuse no good cell."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_client.insertion.geometry import WorkPose
from robot_client.session.commission.wiring import SIDES, dangerous_mistakes, mistakes, probe_of
from service.contract import wire
from service.contract.words.wiring import WIRINGS
from tests.robot_client.insertion.stories import correction


def felt(x_mm, theta_deg, sigmas=(2.0, 4.0), turns=None):
    """A correction with this estimate of the error."""
    estimate = {"dx_mm": x_mm, "dtheta_deg": theta_deg, "sigma_x_mm": sigmas[0], "sigma_theta_deg": sigmas[1]}
    update = {"estimate": wire.Estimate(**estimate), "turns_deg": turns}
    return correction(1).model_copy(update=update)


def undecided(reason, turns=None):
    """No decision for this reason."""
    return wire.NoDecision(insertion_id="p", attempt=1, reason=reason, detail="why", turns_deg=turns)


def answers(signs=(1, 1), off=(0.0, 0.0), reason="", turned=(-0.2, 0.2)):
    """Answers of a cell with these signs and offsets on the four sides, or none; ``turned``: at +x."""
    for x, theta in SIDES:
        turns = tuple(turn * x / 8.0 for turn in turned)
        answer = felt(signs[0] * 0.7 * x + off[0], signs[1] * 0.7 * theta + off[1], turns=turns)
        at_pose = WorkPose(x_mm=x, y_mm=0.0, z_mm=35.0, yaw_deg=theta)
        yield probe_of("p", at_pose, undecided(reason, turns) if reason else answer)


def all_went_in():
    """Probes that went in on all four sides."""
    return tuple(probe_of("p", WorkPose(x_mm=x, y_mm=0.0, z_mm=35.0, yaw_deg=theta), None) for x, theta in SIDES)


@pytest.mark.parametrize("signs", WIRINGS)
def test_a_cell_that_is_wired_wrong_is_named_by_its_signs(signs):
    assert mistakes(tuple(answers(signs))) == (WIRINGS[signs],)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"off": (6.0, 0.0)}, "mm in x"),
        ({"off": (0.0, -9.0)}, "deg in yaw"),
        ({"signs": (0, 1)}, "x"),
        ({"reason": "contradictory"}, "contradictory: why"),
        ({"reason": "out_of_distribution"}, "out_of_distribution: why"),
    ],
)
def test_a_cell_that_is_framed_wrong_or_feels_nothing_is_named(wrong, says):
    (named,) = mistakes(tuple(answers(**wrong)))
    assert says in named


@pytest.mark.parametrize(
    ("below_mm", "named"),
    [
        ((4.6, 4.2, 4.9, 5.0), "the block tops are up to 4.2 mm lower than taught"),
        ((4.6, None, None, None), "the block tops are up to 4.6 mm lower than taught"),
        ((4.6, 1.9, 4.9, 5.0), ""),
        ((1.9, 1.9, 1.9, 1.9), ""),
        ((None,) * 4, ""),
    ],
)
def test_blocks_that_are_lower_than_taught_are_named_because_full_depth_would_end_above_the_bottom(below_mm, named):
    """An object that jams between the blocks touches lower down, but not on all four sides."""
    probes = zip(answers(), below_mm, strict=True)
    signs = tuple(probe.model_copy(update={"below_mm": below}) for probe, below in probes)
    assert [cause.partition(",")[0] for cause in mistakes(signs)] == [named] * bool(named)
    assert all("or the pictures come late" in cause for cause in mistakes(signs)), "they make a touch seem lower"
    assert dangerous_mistakes(signs) == mistakes(signs)


def test_a_cell_where_everything_goes_in_feels_nothing():
    (named,) = mistakes(all_went_in())
    assert "nothing was felt" in named


@given(st.floats(-1.0, 1.0), st.floats(-1.5, 1.5))
def test_a_good_cell_is_never_accused(x, theta):
    assert mistakes(tuple(answers(off=(x, theta)))) == ()


def test_a_yaw_that_is_not_felt_is_no_mistake_and_leaves_both_causes():
    assert mistakes(tuple(answers((1, 0)))) == ()
    assert mistakes(tuple(answers((-1, 0)))) == (WIRINGS[-1, 1], WIRINGS[-1, -1])


@pytest.mark.parametrize("sigma_deg", [3.0, 5.0, 8.0, 20.0])
def test_a_part_that_hardly_feels_the_yaw_accuses_no_cell_and_one_that_feels_it_names_a_reversed_one(sigma_deg):
    """Estimates are posterior means of a measurement with this sigma; the prior is that of the networks."""
    rng, prior_deg, cells_n = np.random.default_rng(0), 15.0 / 3.0**0.5, 1000
    known = prior_deg**2 / (prior_deg**2 + sigma_deg**2)
    accused_n = named_n = 0
    for signs_yaw in (1, -1) * cells_n:
        signs = []
        for x, theta in SIDES:
            yaw = known * (signs_yaw * theta + rng.normal(0.0, sigma_deg))
            at_pose = WorkPose(x_mm=x, y_mm=0.0, z_mm=35.0, yaw_deg=theta)
            signs.append(probe_of("p", at_pose, felt(x, yaw, (2.0, known**0.5 * sigma_deg))))
        accused_n += (named := bool(mistakes(tuple(signs)))) and signs_yaw == 1
        named_n += named and signs_yaw == -1
    assert accused_n <= cells_n / 100
    assert named_n >= {3.0: 0.99, 5.0: 0.8}.get(sigma_deg, 0.0) * cells_n


@pytest.mark.parametrize(("turned", "finger"), [((0.2, 0.15), "left"), ((-0.15, -0.2), "right")])
def test_one_mirrored_picture_is_named_by_the_turns_that_both_fingers_see(turned, finger):
    for cell in (answers((0, 0), turned=turned), answers(reason="out_of_distribution", turned=turned)):
        (named,) = mistakes(tuple(cell))
        assert f"the {finger} picture is mirrored" in named
    assert mistakes(tuple(answers(turned=(0.07, 0.06)))) == ()  # too little to be a turn
    assert mistakes(tuple(answers(turned=(1.5, 0.3)))) == ()  # not of one rigid object


def test_what_goes_in_on_one_side_tells_where_the_gap_is():
    good = tuple(answers(off=(5.0, 0.0)))
    (named,) = mistakes(tuple(f if probe.x_mm < 0 else probe for probe, f in zip(good, all_went_in(), strict=True)))
    assert "off by about +5.3 mm in x" in named


def test_a_sure_estimate_outweighs_what_was_not_felt():
    """Two sides that feel no yaw and say anything, with a large sigma, and two that feel it."""
    pose = {"y_mm": 0.0, "z_mm": 35.0}
    yaws = [(-9.0, 10.0), (9.0, 10.0), (-8.0, 3.0), (8.0, 3.0)]
    signs = tuple(
        probe_of("p", WorkPose(x_mm=x, yaw_deg=theta, **pose), felt(x, yaw, (2.0, sigma)))
        for (x, theta), (yaw, sigma) in zip(SIDES, yaws, strict=True)
    )
    assert mistakes(signs) == ()
