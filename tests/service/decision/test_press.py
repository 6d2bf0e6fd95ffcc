"""How long a press is, and what is felt of it."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.contract import Sensor
from service.contract.model_card import Lattice, Pressing
from service.decision.network_input import Descent, shows_press
from service.perception.markers.field import TrackStatus, field_from_gel
from service.perception.observation import PairObservation
from service.perception.pressing import Legs
from tests.service.decision.test_claim import PERIOD_NS, pair


def test_a_press_is_as_long_as_asked_and_as_the_gel_sticks_but_never_shorter_than_four_steps() -> None:
    pressing: Any = SimpleNamespace(steps_n=12, step_mm=0.1, lattice=None)
    frame = SimpleNamespace(width_px=10, height_px=10)
    card: Any = SimpleNamespace(pressing=pressing, frame=frame, profile=SimpleNamespace(mm_per_px=0.1))
    cases = [(0.8, None, 8), (0.8, 0.3, 6), (0.8, 0.45, 8), (0.8, 0.1, 4), (0.2, None, 4), (3.0, None, 12)]
    for press_mm, reach_mm, steps_n in cases:
        assert Descent(card, {"shear_reach_mm": reach_mm}, press_mm).worth_n == steps_n
    still = Descent(card, {"shear_reach_mm": 0.1}, 0.8, until_slip=True)
    assert (still.worth_n, still.enough, still.felt, still.pressed_mm) == (20, False, False, 0.0)


LATTICE = Lattice(rows=11, columns=15, pitch_mm=1.5)


@pytest.mark.parametrize(("axis", "points_n", "felt"), [(0, 10, True), (1, 10, True), (1, 9, False), (2, 99, False)])
def test_a_press_is_felt_where_ten_points_of_the_lattice_move_by_a_tenth_of_it(
    axis: int, points_n: int, felt: bool
) -> None:
    """Sideways or down, by either finger; that a point is seen is no motion. After 4 steps of 0.1 mm."""
    moved = np.zeros((2, LATTICE.rows, LATTICE.columns, 3), np.float32)
    moved.reshape(-1, 3)[:points_n, axis] = -0.041
    assert shows_press(moved, 0.4, LATTICE) == felt
    assert not shows_press(0.9 * moved, 0.4, LATTICE)


def carried_by(object_mm: np.ndarray, radius_mm: float) -> np.ndarray:
    """[rows, columns, 3]: the gel's motion where it touches an object that moves by [rows, columns, 2]."""
    touched = np.hypot(*np.moveaxis(LATTICE.points_mm, -1, 0)) <= radius_mm
    return np.concatenate([object_mm * touched[..., None], np.ones((*touched.shape, 1))], -1).astype(np.float32)


@given(turn_deg=st.floats(0.15, 2.0), side=st.sampled_from([-1.0, 1.0]), sag_mm=st.floats(0.0, 0.02))
def test_a_turn_in_a_small_contact_shows_a_press(turn_deg: float, side: float, sag_mm: float) -> None:
    """Five lattice points touch: too few for their motion to count, as with a wide light object in a soft gel."""
    u, v = np.moveaxis(LATTICE.points_mm, -1, 0)
    turned, sagged = side * math.radians(turn_deg) * np.stack([-v, u], -1), np.array([0.0, sag_mm])
    moved = np.stack([carried_by(sagged + turned, 1.6), carried_by(sagged - turned, 1.6)])
    assert shows_press(moved, 0.75, LATTICE)


@given(share=st.floats(0.0, 0.09), radius_mm=st.floats(1.6, 12.0))
def test_a_sag_is_no_press(share: float, radius_mm: float) -> None:
    sagged = carried_by(np.broadcast_to((0.0, 0.75 * share), LATTICE.points_mm.shape), radius_mm)
    assert not shows_press(np.stack([sagged, sagged]), 0.75, LATTICE)


SENSOR, TOUCH_MM, MM_S = Sensor.load(), 1.9, 10.0


def pressed(number: int) -> PairObservation:
    """The pair with this number of a descent, which presses from 1.9 mm on: both gels follow by half of it."""
    stamp_ns, gel = number * PERIOD_NS, np.zeros((20, 21, 3), np.float32)
    gel[..., 1] = -0.5 * max(0.0, stamp_ns * 1e-9 * MM_S - TOUCH_MM)
    field = field_from_gel(gel, stamp_ns, SENSOR)
    left, right = (replace(one, captured_ns=stamp_ns, field=field) for one in pair().fingers)
    return PairObservation(left, right)


def steps_of(pairs: list[PairObservation], first: int) -> np.ndarray:
    """The steps of depth of these pairs, of which ``first`` is the first that shows motion."""
    spec = Pressing(lattice=LATTICE, step_mm=0.15, steps_n=4, trained={})
    card: Any = SimpleNamespace(pressing=spec, frame=SENSOR.rectified, profile=SENSOR)
    arm = Legs()
    arm.add(0, MM_S)
    descent = Descent(card, {"speed_mm_s": MM_S}, 0.6, arm)
    complete = descent.begin(pairs[: first + 1], first)
    for one in pairs[first + 1 :]:
        complete += descent.add(one)
    return np.stack(complete)


@pytest.mark.parametrize("number", [0, 2, 5, 6, 7])
@pytest.mark.parametrize("status", ["lost", "ambiguous", "duplicate"])
def test_a_pair_of_which_a_finger_shows_nothing_new_hides_and_delays_no_motion(
    number: int, status: TrackStatus
) -> None:
    """One dark or repeated picture, at rest, at the onset or in the press; the sixth pair is the first to show it."""
    pairs = [pressed(k) for k in range(10)]
    last = pairs[max(0, number - 1)].right.field
    valid = last.valid & (status == "duplicate")
    blind = replace(last, status=status, valid=valid, captured_ns=number * PERIOD_NS)
    some = [replace(one, right=replace(one.right, field=blind)) if one is pairs[number] else one for one in pairs]
    assert steps_of(some, 6) == pytest.approx(steps_of(pairs, 6), abs=1e-4)


def test_where_no_pair_shows_a_finger_at_rest_its_motion_is_not_known() -> None:
    pairs = [pressed(k) for k in range(10)]
    blind = [replace(one.right.field, status="lost", valid=np.zeros_like(one.right.field.valid)) for one in pairs]
    some = [
        replace(one, right=replace(one.right, field=dark)) if k < 6 else one
        for k, (one, dark) in enumerate(zip(pairs, blind, strict=True))
    ]
    shown = steps_of(some, 6)
    assert not shown[:, 1].any()
    assert shown[:, 0] == pytest.approx(steps_of(pairs, 6)[:, 0], abs=1e-4)
