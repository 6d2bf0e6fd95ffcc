"""The turn left by a blocked attempt: the object's turn beyond the part that the gels turned back."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.perception.observation import PairObservation
from service.perception.slip.detector import SlipDetector
from service.perception.turning import (
    GIVEN_BACK,
    GOING_IN_DEG,
    HANGS_DEG,
    hangs_turned,
    lasting_turn_deg,
    turned_going_in,
)
from tests.service.decision.test_claim import descent, observation
from tests.service.perception.synthetic import patch_fields, twist

HELD_PX = 60.0


def finger(name, turn_rad=0.0, back_rad=0.0):
    """A finger whose object turned by ``turn_rad``, and whose markers lie turned by ``back_rad``."""
    shown = observation(name)
    place = shown.field.rest_px - shown.field.rest_px.reshape(-1, 2).mean(0)
    moved = back_rad * np.stack([-place[..., 1], place[..., 0]], -1)
    field = replace(shown.field, displacement_px=moved.astype(np.float32), valid=np.ones(moved.shape[:2], np.bool_))
    slip = replace(shown.slip, angle_rad=turn_rad, sticking=np.ones(moved.shape[:2], np.bool_))
    return replace(shown, field=field, slip=slip)


def last(turn_rad, back_rad=0.0):
    """Both fingers' last frames of an attempt."""
    return PairObservation(finger("left", turn_rad, back_rad), finger("right", -turn_rad, -back_rad))


FREE = last(0.0)


def pressed(turn_rad, back_rad):
    attempt = descent(depth_mm=12.5)
    attempt.pushes = [push._replace(moved_pitch=max(0.0, k - 50.0)) for k, push in enumerate(attempt.pushes)]
    attempt.ring.append(last(turn_rad, back_rad))
    return attempt


def hanging(turn_deg, around_deg=0.0):
    """A pair whose markers within HELD_PX of (163, 160) px lie turned against the open gels, and those around them."""
    fingers = []
    for name, sign in (("left", 1.0), ("right", -1.0)):
        shown = observation(name)
        rest, middle = shown.field.rest_px, np.array([163.0, 160.0])
        held = np.hypot(*np.moveaxis(rest - middle, -1, 0))[..., None] <= HELD_PX
        moved = np.where(held, twist(rest, sign * turn_deg, middle), twist(rest, sign * around_deg, middle)) - rest
        field = replace(shown.field, displacement_px=moved.astype(np.float32), valid=np.ones(moved.shape[:2], np.bool_))
        fingers.append(replace(shown, field=field))
    return PairObservation(*fingers)


@given(st.floats(-0.2, 0.2))
def test_of_a_turn_that_the_gels_take_back_nothing_stays(turn_rad):
    assert lasting_turn_deg(last(turn_rad, turn_rad / GIVEN_BACK), FREE) == pytest.approx(0.0, abs=1e-3)


@given(st.floats(0.005, 0.2), st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.sampled_from([-1.0, 1.0]))
def test_the_less_of_a_turn_goes_back_the_more_of_it_stays(turn_rad, one, two, sign):
    less, more = sorted((one, two))
    stays = [sign * lasting_turn_deg(last(sign * turn_rad, sign * share * turn_rad), FREE) for share in (less, more)]
    assert stays[0] >= stays[1] - 1e-3
    assert stays[0] <= math.degrees(turn_rad) + 1e-3


@pytest.mark.parametrize(("shown_deg", "too_much"), [(0.48, False), (0.52, True), (-0.48, False), (-0.52, True)])
def test_half_a_degree_is_too_much_for_an_object_that_hangs_or_goes_in(shown_deg, too_much):
    assert bool(hangs_turned(hanging(shown_deg))[1]) is too_much
    assert bool(turned_going_in(hanging(shown_deg), hanging(0.0))[1]) is too_much
    assert bool(turned_going_in(last(math.radians(shown_deg)), FREE)[1]) is too_much


def test_the_gels_turn_an_object_back_by_a_twelfth_more_than_their_markers_show():
    assert lasting_turn_deg(last(math.radians(2.0), math.radians(1.0)), FREE) == pytest.approx(2.0 - 1.08, abs=1e-3)


@pytest.mark.parametrize(("left_deg", "right_deg"), [(2.0, -0.5), (0.5, -2.0)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_finger_that_shows_more_of_a_turn_counts_signed_as_the_left_one_sees_it(left_deg, right_deg, sign):
    seen_rad = np.radians(sign * np.array([left_deg, right_deg]))
    both = PairObservation(finger("left", seen_rad[0]), finger("right", seen_rad[1]))
    assert lasting_turn_deg(both, FREE) == pytest.approx(sign * 2.0, abs=1e-3)


@pytest.mark.parametrize("blind", ["left", "right"])
def test_a_turn_that_one_finger_does_not_show_is_not_known_and_the_object_is_taken_afresh(blind):
    both = last(0.1, 0.1)
    shown = getattr(both, blind)
    nothing = np.zeros_like(shown.slip.sticking)
    for slip in (replace(shown.slip, sticking=nothing, slipping=nothing), replace(shown.slip, angle_rad=math.nan)):
        assert math.isnan(lasting_turn_deg(replace(both, **{blind: replace(shown, slip=slip)}), FREE))
    unseen, shape = getattr(FREE, blind), (3, 3)
    for valid in (nothing, np.ones(shape, np.bool_)):  # no marker is found, or another grid
        field = replace(unseen.field, valid=valid)
        assert math.isnan(lasting_turn_deg(both, replace(FREE, **{blind: replace(unseen, field=field)})))


@given(st.floats(-0.05, 0.05), st.sampled_from(["left", "right"]))
def test_an_object_that_turns_on_the_way_down_is_told(turn_rad, shows):
    both = last(0.0)
    shown = getattr(both, shows)
    turned = replace(both, **{shows: replace(shown, slip=replace(shown.slip, angle_rad=turn_rad))})
    turn_deg, why = turned_going_in(turned, both)
    assert bool(why) == (abs(math.degrees(turn_rad)) > GOING_IN_DEG)
    assert turn_deg == pytest.approx(math.degrees(turn_rad) * (0.5 if shows == "left" else -0.5))


@given(st.floats(-6.0, 6.0))
def test_an_object_that_hangs_turned_is_told_from_one_that_hangs_upright(turn_deg):
    shown_deg, reason = hangs_turned(hanging(turn_deg))
    assert shown_deg == pytest.approx(turn_deg, rel=0.05, abs=0.01)
    if abs(turn_deg) > HANGS_DEG + 0.05:
        assert "nearer to its centre of mass" in reason
    if abs(turn_deg) < HANGS_DEG - 0.05:
        assert not reason


@given(st.floats(-0.4, 0.4), st.floats(-4.0, 4.0))
def test_a_contact_that_slid_all_the_way_down_shows_it_against_the_open_gels(hung_deg, down_deg):
    _, reason = turned_going_in(hanging(hung_deg + down_deg), hanging(hung_deg))
    assert bool(reason) == (abs(down_deg) > GOING_IN_DEG) or abs(abs(down_deg) - GOING_IN_DEG) < 0.05


def test_gels_that_nothing_moves_show_no_turn():
    assert hangs_turned(last(0.0)) == (0.0, "")


@pytest.mark.parametrize(("hold_px", "least_deg", "most_deg"), [(np.inf, -0.5, 0.3), (3.0, 0.5, 4.5)])
def test_the_detector_tells_a_gel_that_slid_from_one_that_held(hold_px, least_deg, most_deg):
    fingers, free = [], []
    for name, sign in (("left", 1.0), ("right", -1.0)):
        motion = partial(turning, sign * 4.0 / 19)
        fields, _ = patch_fields(motion, hold_px=hold_px, centre=(163.0, 159.5))
        detector = SlipDetector()
        detector.rearm(fields[0])
        for field in fields[1:]:
            slip = detector.update(field)
        fingers.append(replace(observation(name), field=fields[-1], slip=slip))
        free.append(replace(observation(name), field=fields[0], slip=slip))
    assert least_deg <= lasting_turn_deg(PairObservation(*fingers), PairObservation(*free)) <= most_deg


def turning(step_deg, k, rest):
    """The motion of an object that turns by 4 deg in 20 frames."""
    return twist(rest, step_deg * k) - rest


@pytest.mark.parametrize(("markers_n", "shows"), [(3, False), (4, True)])
def test_a_finger_on_which_too_few_markers_move_shows_no_turn_of_its_own(markers_n, shows):
    """The other one shows 0.8 deg: both together half of it, or all of it where this one shows it, too."""
    both = hanging(0.8)
    moved = both.right.field.displacement_px.copy()
    farthest = np.argsort(np.hypot(*np.moveaxis(moved, -1, 0)), axis=None)[:-markers_n]
    moved.reshape(-1, 2)[farthest] = 0.0
    bare = replace(both, right=replace(both.right, field=replace(both.right.field, displacement_px=moved)))
    assert bool(hangs_turned(bare)[1]) == shows
