"""A grid is found by the topology of its spots, whatever its turn, its gaps and what lies around it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.perception.markers.detect import Candidates
from service.perception.markers.lattice import (
    DIAMETERS_PX,
    Lattice,
    _most_merit,
    _run,
    _strewn,
    _strong,
    assemble,
    fill_gaps,
    find_lattice,
    flood,
    lattice_basis,
    neighbours,
)
from tests.service.perception.synthetic import draw, grid, twist

PITCH = 15.0
REST = grid().astype(np.float32)


def spots(points: np.ndarray) -> Candidates:
    flat = np.asarray(points, np.float32).reshape(-1, 2)
    return Candidates(flat, np.full(len(flat), 50.0, np.float32), np.ones(len(flat), np.float32))


@given(st.floats(-180.0, 180.0), st.integers(0, 100))
def test_the_basis_is_the_quarter_turn_that_is_most_like_what_is_asked_for(degrees: float, seed: int) -> None:
    turned = twist(grid(seed=seed), degrees).reshape(-1, 2).astype(np.float32)
    expected = twist(np.eye(2), degrees, centre=(0.0, 0.0)) * PITCH
    assert lattice_basis(turned, expected.astype(np.float32)) == pytest.approx(expected, abs=0.5)
    quarters = degrees % 90 - 90 * (degrees % 90 > 45)
    if abs(abs(quarters) - 45) > 2:
        upright = twist(np.eye(2), quarters, centre=(0.0, 0.0)) * PITCH
        assert lattice_basis(turned) == pytest.approx(upright, abs=0.5)


def test_few_or_scattered_points_have_no_basis() -> None:
    assert lattice_basis(REST.reshape(-1, 2)[:8]) is None
    assert lattice_basis(REST[:1, :9].reshape(-1, 2)) is None, "a row has no second direction"
    assert lattice_basis(REST[:3, :3].reshape(-1, 2)) is not None
    four_below, three_below = (np.concatenate([REST[0, :8], REST[1, :n]]) for n in (4, 3))
    assert lattice_basis(four_below) is not None, "four steps are a direction"
    assert lattice_basis(three_below) is None


@given(st.integers(0, 1000), st.integers(2, 60))
def test_the_neighbours_of_a_spot_are_the_twelve_nearest_others(seed: int, spots_n: int) -> None:
    points = np.random.default_rng(seed).uniform(0, 300, (spots_n, 2)).astype(np.float32)
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1) + np.diag(np.full(spots_n, np.inf))
    most_n = min(12, spots_n)
    nearest = [set(row[:most_n].tolist()) for row in np.argsort(apart, axis=1)]
    assert [set(row) for row in neighbours(points).tolist()] == nearest


@given(st.lists(st.integers(1, 1000), min_size=1, max_size=80), st.integers(0, 1000))
def test_no_grid_of_some_spots_has_more_merit_than_they_promise(strengths: list[int], seed: int) -> None:
    strongest = np.sort(np.array(strengths, np.float32))[::-1]
    spot = Candidates(np.zeros((len(strongest), 2), np.float32), strongest, np.ones(len(strongest), np.float32))
    rng = np.random.default_rng(seed)
    chosen = strongest[rng.random(len(strongest)) < rng.uniform(0, 1)]
    promised = _most_merit(spot, 5.0)
    assert not chosen.size or len(chosen) * np.median(chosen) * 5.0 <= promised + 1e-6
    firsts = [n * strongest[(n - 1) // 2] for n in range(1, len(strongest) + 1)]
    assert promised == pytest.approx(5.0 * max(firsts)), "and no more than it takes"
    assert _most_merit(spot.only(np.zeros(0, np.intp)), 5.0) == 0.0


def test_spots_of_a_third_of_a_strong_one_are_grain_and_1500_are_enough() -> None:
    strength = np.concatenate([np.full(80, 100.0), np.full(10, 36.0), np.full(10, 34.0)]).astype(np.float32)
    mixed = Candidates(np.zeros((100, 2), np.float32), strength, np.ones(100, np.float32))
    assert len(_strong(mixed).strength) == 90
    many = Candidates(np.zeros((1600, 2), np.float32), np.full(1600, 9.0, np.float32), np.ones(1600, np.float32))
    assert len(_strong(many).strength) == 1500
    assert len(_strong(mixed.only(np.zeros(0, np.intp))).strength) == 0


@given(st.lists(st.booleans(), max_size=20))
def test_a_run_is_the_longest_of_rows_that_count(good: list[bool]) -> None:
    runs = [
        (end - begin, -begin)
        for begin in range(len(good))
        for end in range(begin + 1, len(good) + 1)
        if all(good[begin:end])
    ]
    longest, begin = max(runs, default=(0, 0))
    chosen = _run(np.array(good, bool))
    assert (chosen.start, chosen.stop) == (-begin, longest - begin)


def test_a_flood_follows_a_grid_that_turns_and_widens_from_end_to_end() -> None:
    bent = twist(REST, 0.0) * (1 + 0.4 * (REST[..., :1] / 327))
    bent[..., 1] += 20 * np.sin(REST[..., 0] / 60)
    order = np.random.default_rng(0).permutation(420)
    points = bent.reshape(-1, 2)[order].astype(np.float32)
    seed = int(np.flatnonzero(order == 0)[0])
    basis = np.stack([bent[0, 1] - bent[0, 0], bent[1, 0] - bent[0, 0]]).astype(np.float32)
    index, reached = flood(points, neighbours(points), basis, np.array([seed]), np.array([[0, 0]]))
    assert reached.all()
    assert np.array_equal(index, np.stack([order % 21, order // 21], 1))


def test_a_grid_is_cut_out_of_what_lies_around_it_and_its_gaps_are_filled() -> None:
    kept = np.ones(REST.shape[:2], bool)
    kept[4:6, 5:9] = kept[0, :3] = False
    stray = np.array([[REST[0, 3 * k, 0], REST[0, 0, 1] - PITCH] for k in range(1, 4)])  # a seventh of a row above
    lattice = assemble(spots(np.concatenate([REST[kept], stray])), np.eye(2, dtype=np.float32) * PITCH, 5.0)
    assert lattice is not None
    assert np.array_equal(lattice.detected, kept)
    assert lattice.xy_px[kept] == pytest.approx(REST[kept])
    assert lattice.xy_px == pytest.approx(REST, abs=1.0)
    assert (lattice.pitch_px, lattice.strength) == (pytest.approx(PITCH, rel=0.01), 50.0)


@pytest.mark.parametrize(("share", "counts"), [(0.25, False), (0.5, True)])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_row_at_the_border_counts_if_a_third_of_it_is_there(axis: int, share: float, *, counts: bool) -> None:
    kept = np.ones(REST.shape[:2], bool)
    last = kept[-1] if axis == 0 else kept[:, -1]
    last[round(share * last.size) :] = False
    lattice = assemble(spots(REST[kept]), np.eye(2, dtype=np.float32) * PITCH, 5.0)
    assert lattice is not None
    assert lattice.detected.shape[axis] == REST.shape[axis] - (not counts)


def test_a_stray_spot_in_the_middle_hides_no_grid() -> None:
    stray = REST[9:11, 10].mean(0, keepdims=True)
    lattice = assemble(spots(np.concatenate([stray, REST.reshape(-1, 2)])), np.eye(2, dtype=np.float32) * PITCH, 5.0)
    assert lattice is not None
    assert lattice.xy_px == pytest.approx(REST)


@pytest.mark.parametrize("bend", [-0.4, -0.25, 0.4])
@pytest.mark.parametrize(("rows", "cols"), [(20, 21), (7, 9), (5, 5)])
def test_a_lens_makes_no_strewn_dots_of_a_grid(rows: int, cols: int, bend: float) -> None:
    out = (grid(rows, cols, PITCH) - grid(rows, cols, PITCH).mean((0, 1))) / (0.5 * PITCH * cols)
    bent = 160.0 + 0.5 * PITCH * cols * out * (1.0 + bend * np.square(out).sum(-1, keepdims=True))
    all_of_it = np.ones((rows, cols), bool)
    _, basis = fill_gaps(bent.astype(np.float32), all_of_it)
    lattice = Lattice(bent.astype(np.float32), all_of_it, basis, 5.0, 1.0)
    assert not _strewn(lattice)


@pytest.mark.parametrize(("off_pitch", "strewn"), [(0.12, False), (0.4, True)])
@given(seed=st.integers(0, 1000))
def test_the_limit_lies_between_what_loaded_gels_show_and_dots_at_random(
    off_pitch: float, seed: int, *, strewn: bool
) -> None:
    off = off_pitch * PITCH * np.random.default_rng(seed).uniform(-1, 1, (12, 12, 2))
    placed = (grid(12, 12, PITCH) + off).astype(np.float32)
    basis = np.eye(2, dtype=np.float32) * PITCH
    assert _strewn(Lattice(placed, np.ones((12, 12), bool), basis, 5.0, 1.0)) is strewn


@pytest.mark.parametrize(("rows", "cols", "enough"), [(5, 5, True), (4, 9, False), (9, 4, False)])
def test_a_grid_has_five_rows_and_columns_at_least(rows: int, cols: int, enough: bool) -> None:
    image = draw(grid(rows, cols, 24.0, 320, 320), np.random.default_rng(0), 320, 320, 8.0)
    assert (find_lattice(image) is not None) is enough


def square(diameter: float, apart: float) -> Lattice | None:
    """What is found of 6 x 6 markers that are so many diameters apart."""
    pitch = apart * diameter
    side = int(6 * pitch)
    points = grid(6, 6, pitch, side, side, jitter=0.01 * pitch)
    return find_lattice(draw(points, np.random.default_rng(0), side, side, diameter))


@pytest.mark.parametrize("apart", [2.6, 4.0])
@pytest.mark.parametrize("diameter", DIAMETERS_PX)
def test_markers_of_4_to_25_px_are_found_by_the_scale_nearest_to_them(diameter: float, apart: float) -> None:
    lattice = square(diameter, apart)
    assert lattice is not None
    assert lattice.detected.all()
    assert lattice.pitch_px == pytest.approx(apart * diameter, rel=0.01)
    assert lattice.diameter_px == pytest.approx(diameter, rel=0.25)


@pytest.mark.parametrize(
    ("diameter", "apart", "counts"), [(4, 1.35, False), (4, 1.45, True), (25, 7.6, True), (25, 8.4, False)]
)
def test_markers_are_one_and_a_half_to_eight_diameters_apart(diameter: float, apart: float, *, counts: bool) -> None:
    """Of the least and of the largest diameter: others have a scale beside their own, by which they are found."""
    assert (square(diameter, apart) is not None) is counts


@given(st.lists(st.floats(-20.0, 20.0), min_size=8, max_size=8), st.integers(0, 1000))
def test_gaps_are_filled_as_a_cubic_surface_goes_on(bend_px: list[float], seed: int) -> None:
    """In each coordinate x^3, x^2 y, x y^2 and y^3, x and y from -1/2 to 1/2."""
    detected = np.random.default_rng(seed).random((12, 14)) < 0.6
    if detected.sum() < 60:
        return
    v, u = np.mgrid[0:12, 0:14].astype(np.float64)
    x, y = u / 13 - 0.5, v / 11 - 0.5
    cubic = np.stack([x**3, x * x * y, x * y * y, y**3], -1)
    surface = np.stack([u * PITCH + cubic @ bend_px[:4], v * PITCH + cubic @ bend_px[4:]], -1).astype(np.float32)
    filled, basis = fill_gaps(np.where(detected[..., None], surface, 0.0).astype(np.float32), detected)
    assert filled == pytest.approx(surface, abs=1e-2)
    steps = np.stack([np.diff(surface, axis=1).mean((0, 1)), np.diff(surface, axis=0).mean((0, 1))])
    assert basis == pytest.approx(steps, abs=1e-2)


def test_with_few_markers_gaps_are_filled_as_a_plane_goes_on() -> None:
    detected = np.zeros((6, 6), bool)
    detected[::2, ::2] = True
    small = grid(6, 6, PITCH, 100, 100, jitter=0.0).astype(np.float32)
    filled, _ = fill_gaps(np.where(detected[..., None], small, 0.0).astype(np.float32), detected)
    assert filled == pytest.approx(small, abs=1e-3)


@pytest.mark.parametrize(("pitch", "diameter"), [(15.0, 5.0), (24.0, 9.0), (34.0, 14.0)])
def test_the_grid_is_that_of_the_best_scale_although_not_every_scale_is_linked(
    pitch: float, diameter: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows, columns = int(320 / pitch) - 1, int(327 / pitch) - 1
    image = draw(grid(rows, columns, pitch), np.random.default_rng(3), diameter=diameter)
    chosen = find_lattice(image)
    alone = []
    for scale in DIAMETERS_PX:
        monkeypatch.setattr("service.perception.markers.lattice.DIAMETERS_PX", (scale,))
        alone.append(find_lattice(image))
    best = max((one for one in alone if one), key=lambda one: one.detected.sum() * one.strength * one.diameter_px)
    assert chosen is not None
    assert chosen.diameter_px == best.diameter_px
    assert np.array_equal(chosen.xy_px, best.xy_px)
