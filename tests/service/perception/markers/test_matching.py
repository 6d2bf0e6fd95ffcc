"""Spots are assigned to nodes as by trying them all, and a placement is as good as it explains the frame."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from service.perception.markers.matching import (
    _STEPS,
    Match,
    View,
    _affine,
    _bridged,
    _fit_n,
    _motion,
    _placed,
    _torn,
    match,
    nearest_spot,
    reindex,
)
from service.perception.markers.tracker import MarkerTracker
from tests.service.perception.synthetic import draw, grid, stretched, twist

PITCH = 15.0
VIEW = View(327, 320, 3.0)
REST = grid().astype(np.float32)


def by_trying_all(predicted: np.ndarray, points: np.ndarray, reach: float) -> np.ndarray:
    """The nearest spot of each node within reach; a spot that two nodes claim belongs to the nearer one."""
    apart = np.linalg.norm(predicted.reshape(-1, 1, 2) - points[None], axis=-1)
    nearest = np.where(apart.min(1) < reach, apart.argmin(1), -1)
    for spot in set(nearest.tolist()) - {-1}:
        rivals = np.flatnonzero(nearest == spot)
        nearest[rivals[apart[rivals, spot] > apart[rivals, spot].min()]] = -1
    return np.asarray(nearest.reshape(predicted.shape[:2]))


@given(st.integers(0, 10_000), st.floats(0.0, 0.3), st.floats(-0.45, 0.45), st.floats(0.0, 0.5))
def test_the_nearest_spot_is_that_of_trying_them_all(seed: int, scatter: float, off: float, lost: float) -> None:
    rng = np.random.default_rng(seed)
    nodes = grid(6, 7, PITCH, 120, 110, jitter=0.0).astype(np.float32)
    spots = (nodes + rng.normal(0, scatter * PITCH, nodes.shape) + off * PITCH).reshape(-1, 2)
    spots = spots[rng.random(len(spots)) >= lost].astype(np.float32)
    if not len(spots):
        return
    reach = 0.46 * PITCH
    close = np.linalg.norm(spots[:, None] - spots[None], axis=-1) + 1e9 * np.eye(len(spots))
    spots = spots[close.min(1) > 1.5 * reach]  # of two spots in one cell of its table the search knows one
    if len(spots):
        assert np.array_equal(nearest_spot(nodes, spots, reach), by_trying_all(nodes, spots, reach))


def test_a_grid_in_its_place_has_no_misfit_and_each_missing_or_stray_spot_costs() -> None:
    points = REST.reshape(-1, 2)
    whole = match(REST, REST, points, PITCH, VIEW, REST)
    assert (whole.misfit, whole.torn_n, whole.valid.all()) == (pytest.approx(0.0, abs=1e-6), 0, True)
    assert np.array_equal(whole.spot.ravel(), np.arange(REST[..., 0].size))
    fewer = match(REST, REST, points[:-3], PITCH, VIEW, REST)
    assert fewer.misfit == pytest.approx(3 * 25.0 / 420)
    stray = np.concatenate([points, points[:4] + PITCH / 2])
    assert match(REST, REST, stray, PITCH, VIEW, REST).misfit == pytest.approx(4 * 12.5 / 420)


def test_a_node_pulled_away_from_its_neighbours_is_torn_and_lies_where_they_say() -> None:
    moved = REST + np.array([2.0, -1.0], np.float32)
    torn = moved.copy()
    torn[8, 9] += (0.0, 8.0)
    placed = match(torn, REST, torn.reshape(-1, 2), PITCH, VIEW, REST)
    assert placed.torn_n == 1
    assert not placed.valid[8, 9]
    assert placed.spot[8, 9] == -1
    assert placed.xy_px[8, 9] == pytest.approx(moved[8, 9], abs=0.3)


@pytest.mark.parametrize("jump", [(13.5, 0.0), (0.0, -13.5), (30.0, 15.0), (-45.0, 0.0)])
def test_a_grid_with_a_hole_keeps_its_identity_over_a_jump(jump: tuple[float, float]) -> None:
    moved = REST + np.array(jump, np.float32)
    there = VIEW.contains(moved)
    there[7:13, 6:12] = False
    prior = match(REST, REST, moved[there], PITCH, VIEW, REST)
    placed = reindex(moved[there], REST, PITCH, VIEW, REST, prior, 1.0)
    assert np.array_equal(placed.valid, there)
    assert placed.xy_px[there] == pytest.approx(moved[there])


def test_a_stretched_grid_is_linked_from_the_nodes_that_stand_still() -> None:
    moved = stretched(REST, 26.0)
    prior = match(REST, REST, moved.reshape(-1, 2), PITCH, VIEW, REST)
    assert not np.array_equal(prior.spot.ravel(), np.arange(420)), "some are taken for their neighbours at first"
    placed = reindex(moved.reshape(-1, 2), REST, PITCH, VIEW, REST, prior, 1.0)
    assert np.array_equal(placed.spot.ravel(), np.arange(420))


def test_an_island_in_a_hole_of_a_stretched_grid_is_reached_over_the_gap() -> None:
    moved, there = stretched(REST, 18.0), np.ones(REST.shape[:2], bool)
    there[6:14, 11:18] = False
    there[8:12, 13:16] = True
    prior = match(REST, REST, moved[there], PITCH, VIEW, REST)
    placed = reindex(moved[there], REST, PITCH, VIEW, REST, prior, 1.0)
    assert np.array_equal(placed.valid, there)
    assert placed.xy_px[there] == pytest.approx(moved[there])


def test_a_grid_that_turned_by_a_third_of_a_right_angle_is_no_other_placement() -> None:
    moved = twist(REST, 30).astype(np.float32)
    there = VIEW.contains(moved)
    prior = match(REST, REST, moved[there], PITCH, VIEW, REST)
    placed = reindex(moved[there], REST, PITCH, VIEW, REST, prior, 1.0)
    assert np.array_equal(placed.valid, there)
    assert placed.xy_px[there] == pytest.approx(moved[there])


@pytest.mark.parametrize(("missing_n", "linked"), [(0, False), (6, False), (7, True), (60, True)])
def test_an_uneven_grid_is_linked_anew_only_where_more_than_a_third_of_a_row_is_missing(
    monkeypatch: pytest.MonkeyPatch, missing_n: int, *, linked: bool
) -> None:
    """It takes 50 to 100 ms, which an arm in contact cannot wait for."""
    rng, calls, tracker = np.random.default_rng(9), [], MarkerTracker()
    monkeypatch.setattr(
        "service.perception.markers.tracker.reindex", lambda *asked: calls.append(asked) or reindex(*asked)
    )
    there = np.ones(REST.shape[:2], bool)
    there[8:11].flat[:missing_n] = False
    tracker.update(draw(REST, rng), 0)
    field = tracker.update(draw((REST + rng.normal(0, 1.2, REST.shape))[there], rng), 33_000_000)
    assert field.valid.sum() > 0.98 * there.sum()
    assert bool(calls) is linked


@pytest.mark.parametrize(("n", "why"), [(3, "3 markers in sight"), (4, "4 of 420 markers matched")])
def test_a_grid_is_lost_with_few_markers_in_sight(n: int, why: str) -> None:
    rng, tracker = np.random.default_rng(3), MarkerTracker()
    tracker.update(draw(REST, rng), 0)
    field = tracker.update(draw(REST[9, 8 : 8 + n], rng), 33_000_000)
    assert (field.status, field.reason, field.valid.any()) == ("lost", why, False)


def test_room_is_the_distance_to_the_nearest_border() -> None:
    places = np.array([[0.0, 50.0], [326.0, 319.0], [163.0, 10.0], [320.0, 160.0], [-4.0, 160.0]], np.float32)
    assert VIEW.room_px(places) == pytest.approx([0.0, 0.0, 10.0, 6.0, -4.0])
    assert VIEW.contains(places).tolist() == [False, False, True, True, False]


@given(st.integers(0, 1000))
def test_what_fits_on_a_grid_after_each_step_is_counted_as_by_placing_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cells = rng.permutation(np.argwhere(np.ones((9, 8))))[: rng.integers(1, 60)] - 2
    counted = _fit_n(cells, _STEPS, (5, 4))
    placed = [int((_placed(cells + step, np.arange(len(cells)), (5, 4)) >= 0).sum()) for step in _STEPS]
    assert counted == placed


def test_spots_are_placed_at_column_and_row_of_their_cells() -> None:
    placed = _placed(np.array([(3, 0), (0, 4), (4, 0), (0, 5), (-1, 2)]), np.array([7, 8, 1, 2, 3]), (5, 4))
    assert (placed[0, 3], placed[4, 0], int((placed >= 0).sum())) == (7, 8, 2)


@given(st.integers(0, 1000), st.sampled_from([(5, 6), (9, 8)]), st.floats(0.2, 1.5))
def test_a_node_is_torn_if_it_is_off_the_median_of_three_neighbours_or_more(
    seed: int, shape: tuple[int, int], spread: float
) -> None:
    """Whatever is known before the medians are taken."""
    rng = np.random.default_rng(seed)
    moved, valid = rng.normal(0, spread, (*shape, 2)).astype(np.float32), rng.random(shape) < rng.uniform(0.2, 1.0)
    torn = np.zeros(shape, bool)
    for row, column in np.argwhere(valid):
        around = np.s_[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2]
        others = valid.copy()
        others[row, column] = False
        off = (
            moved[row, column] - np.median(moved[around][others[around]], axis=0)
            if others[around].any()
            else np.zeros(2)
        )
        torn[row, column] = others[around].sum() >= 3 and np.hypot(*off) > 2.0
    assert np.array_equal(_torn(moved, valid, 2.0), torn)


@example(0, 11)
@example(0, 12)
@given(st.integers(0, 1000), st.integers(10, 40))
def test_a_grid_is_carried_by_the_affine_map_that_fits_twelve_nodes_or_more(seed: int, nodes_n: int) -> None:
    rng, valid = np.random.default_rng(seed), np.zeros(REST.shape[:2], bool)
    valid.flat[rng.permutation(valid.size)[:nodes_n]] = True
    moved = (REST @ rng.normal(0, 1.0, (2, 2)) + rng.normal(0, 20.0, (20, 21, 2)) + (30, -20)).astype(np.float32)
    expected = REST
    if nodes_n >= 12:
        terms = np.concatenate([REST, np.ones((20, 21, 1))], -1).astype(np.float64)
        expected = terms @ np.linalg.lstsq(terms[valid], moved[valid].astype(np.float64), rcond=None)[0]
    assert _affine(REST, moved, valid) == pytest.approx(expected, abs=1e-3)


def test_nodes_on_a_line_carry_no_grid() -> None:
    even = grid(jitter=0.0).astype(np.float32)
    down, right = np.indices(REST.shape[:2])
    for line in (down == 7, right == 7, down == right, down + right == 19):
        assert np.array_equal(_affine(even, 2 * even, line), even)
        aside = line.copy()
        aside[8, 3] = True
        assert _affine(even, 2 * even, aside) == pytest.approx(2 * even, rel=1e-3)


def placed_at(moved_px: np.ndarray, valid: np.ndarray) -> Match:
    return Match((REST + moved_px).astype(np.float32), valid, 0.0, 0.0, 0, np.zeros(valid.shape, np.intp))


def test_motion_costs_half_a_point_a_pitch_and_nothing_in_sight_as_much_as_a_missing_marker() -> None:
    valid = np.random.default_rng(0).random(REST.shape[:2]) < 0.5
    moved = np.where(valid[..., None], (6.0, -8.0), (90.0, 0.0))
    assert _motion(placed_at(moved, valid), REST, PITCH) == pytest.approx(0.5 * 10 / PITCH, rel=1e-4)
    assert _motion(placed_at(moved, np.zeros_like(valid)), REST, PITCH) == 25.0


def test_nodes_without_a_spot_move_as_those_around_them() -> None:
    """A hole in a grid that is carried as one, and in one that is stretched evenly."""
    valid = np.ones(REST.shape[:2], bool)
    valid[6:12, 7:13] = valid[0, 0] = False
    carried = np.where(valid[..., None], (6.0, -8.0), 0.0)
    assert _bridged(placed_at(carried, valid), REST) == pytest.approx(REST + np.array([6.0, -8.0]), abs=1e-3)
    wider = 0.04 * (REST - REST.mean((0, 1)))
    bridged = _bridged(placed_at(np.where(valid[..., None], wider, 0.0), valid), REST)
    assert bridged[valid] == pytest.approx((REST + wider)[valid], abs=1e-3)
    assert np.abs(bridged - REST - wider)[6:12, 7:13].max() < 0.1 * PITCH
