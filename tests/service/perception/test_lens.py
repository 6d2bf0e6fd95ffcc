"""A lens and a warp against closed forms, and every distortion against its inverse."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.perception.lens import Lens, Projection, Warp, order_of

WIDTH_PX, HEIGHT_PX = 427, 320
LOW, HIGH = np.array([10.0, 20.0]), np.array([310.0, 280.0])
TILTED = np.array([[0.9, 0.1, 12.0], [-0.05, 1.1, -7.0], [1e-4, -2e-4, 1.0]])


def lenses():
    centre = st.tuples(st.floats(180, 240), st.floats(130, 190))
    return st.builds(Lens, centre, st.just(266.8), st.floats(-0.1, 0.3), st.floats(-0.05, 0.1))


def warps(order: int, most_px: float = 2.0):
    terms = (order + 1) * (order + 2) // 2
    rows = st.lists(st.floats(-most_px / terms, most_px / terms), min_size=terms, max_size=terms)
    return st.tuples(rows, rows).map(lambda rows: Warp(LOW, HIGH, np.array(rows)))


def points(seed: int, n: int = 50) -> np.ndarray:
    return np.random.default_rng(seed).uniform(LOW, HIGH, (n, 2))


def test_a_lens_moves_a_point_along_its_radius_by_both_terms():
    lens = Lens((200.0, 160.0), 100.0, 0.1, 0.02)
    ideal = lens.ideal(np.array([[200.0, 160.0], [300.0, 160.0], [200.0, -40.0]]))
    assert ideal == pytest.approx(np.array([[200.0, 160.0], [312.0, 160.0], [200.0, 160 - 200 * (1 + 0.4 + 0.32)]]))


@given(lenses(), st.integers(0, 1000))
def test_a_lens_is_undone(lens, seed):
    raw = np.concatenate([points(seed), [(0, 0), (WIDTH_PX, 0), (WIDTH_PX, HEIGHT_PX), lens.centre_px]])
    assert lens.one_to_one(WIDTH_PX, HEIGHT_PX)
    assert lens.raw(lens.ideal(raw)) == pytest.approx(raw, abs=1e-6)


@pytest.mark.parametrize(
    ("lens", "sound"),
    [
        (Lens((213.0, 160.0), 266.8, 0.0, 0.0), True),
        (Lens((213.0, 160.0), 266.8, -0.15, 0.0), True),
        (Lens((213.0, 160.0), 266.8, -0.4, 0.0), False),
        (Lens((213.0, 160.0), 266.8, 0.0, -0.15), False),
        (Lens((213.0, 160.0), 266.8, -0.8, 0.6), True),
        (Lens((213.0, 160.0), 266.8, -0.9, 0.7), False),  # it folds half-way to the corners, not at them
        (Lens((213.0, 160.0), 0.0, 0.0, 0.0), False),
        (Lens((213.0, 160.0), 266.8, float("nan"), 0.0), False),
        (Lens((0.0, 0.0), 266.8, -0.15, 0.0), False),  # the far corner counts, wherever the centre lies
    ],
)
def test_a_lens_that_folds_the_frame_is_found(lens, sound):
    assert lens.one_to_one(WIDTH_PX, HEIGHT_PX) is sound


@pytest.mark.parametrize("order", range(1, 7))
def test_a_warp_adds_products_of_legendre_polynomials(order):
    """Term by term: P_i(x) P_j(y) for i + j <= order, of a place that runs from -1 to 1 between the corners."""
    places = points(order)
    x, y = (2 * (places - LOW) / (HIGH - LOW) - 1).T
    pairs = [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]
    for k, (i, j) in enumerate(pairs):
        coefficients = np.zeros((2, len(pairs)))
        coefficients[:, k] = 0.5, -2.0
        one = [np.polynomial.legendre.legval(at, np.eye(7)[degree]) for at, degree in ((x, i), (y, j))]
        added = Warp(LOW, HIGH, coefficients).apply(places) - places
        assert added == pytest.approx(np.outer(one[0] * one[1], (0.5, -2.0)), abs=1e-9)


@given(st.integers(1, 6).flatmap(warps), st.integers(0, 1000))
def test_a_warp_is_undone_and_ends_at_its_corners(warp, seed):
    places = points(seed)
    assert warp.one_to_one()
    assert warp.undo(warp.apply(places)) == pytest.approx(places, abs=1e-4)
    beyond = HIGH + np.array([[50.0, 0.0], [0.0, 30.0], [5.0, 5.0]])
    nearest = np.minimum(beyond, HIGH)
    assert warp.apply(beyond) - beyond == pytest.approx(warp.apply(nearest) - nearest)


@pytest.mark.parametrize(("slope", "sound"), [(0.49, True), (0.51, False), (-0.51, False), (float("nan"), False)])
@pytest.mark.parametrize(("term", "extent_px"), [(2, 300.0), (1, 260.0)])  # P_1(x) and P_1(y)
def test_a_warp_that_moves_a_point_by_half_of_its_way_is_found(term, extent_px, slope, sound):
    coefficients = np.zeros((2, 3))
    coefficients[0, term] = slope * extent_px / 2
    assert Warp(LOW, HIGH, coefficients).one_to_one() is sound


def test_a_warp_without_extent_is_no_warp():
    assert not Warp(LOW, LOW, np.zeros((2, 3))).one_to_one()


@given(lenses(), warps(2), st.integers(0, 1000))
def test_a_projection_is_undone(lens, warp, seed):
    projection = Projection(np.linalg.inv(TILTED), lens, warp)
    raw = points(seed)
    assert projection.raw(projection.plane(raw)) == pytest.approx(raw, abs=1e-3)


@given(lenses(), warps(3), st.floats(0.2, 5.0), st.tuples(st.floats(-50, 50), st.floats(-50, 50)))
def test_a_scaled_projection_scales_its_plane(lens, warp, scale, shift):
    projection, raw = Projection(TILTED, lens, warp), points(3)
    scaled = projection.scaled(scale, np.array(shift))
    assert scaled.plane(raw) == pytest.approx(projection.plane(raw) * scale + np.array(shift), abs=1e-6)


@given(lenses(), warps(3), st.floats(-3.0, 3.0), st.floats(0.5, 2.0))
def test_a_moved_camera_shows_the_same_plane(lens, warp, turn_rad, zoom):
    """What lies at a raw point before lies at the moved point after."""
    turn = cv2.getRotationMatrix2D((100.0, 80.0), np.degrees(turn_rad), zoom)
    change, raw = np.vstack([turn, [0, 0, 1]]), points(4)
    moved = cv2.perspectiveTransform(raw[:, None], change)[:, 0]
    projection = Projection(TILTED, lens, warp)
    assert projection.moved(change).plane(moved) == pytest.approx(projection.plane(raw), abs=1e-6)


def test_only_full_orders_are_warps():
    assert [order_of(n) for n in (3, 6, 10, 15, 21, 28)] == [1, 2, 3, 4, 5, 6]
    for terms in (1, 4, 36):
        with pytest.raises(ValueError, match=f"warp has {terms} terms"):
            order_of(terms)
