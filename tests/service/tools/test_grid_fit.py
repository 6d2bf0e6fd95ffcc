"""The marker grid is found through lenses, debris, flares and gaps; the truth is the drawing's own projection."""

import cv2
import numpy as np
import pytest

from service.__main__ import main
from service.perception.lens import Lens, Projection
from service.tools.grid_fit import fit_grid

SIZE = (427, 320)
ROWS, COLUMNS = 17, 20
SCALE = 8


def projection(rng, k1):
    """Of a camera that looks along the finger through a bending lens; grid units."""
    low, high = np.array([-1.0, -1.0]), np.array([COLUMNS, ROWS])
    far = np.array([(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])], np.float32)
    corners = np.array([(12, 8), (415, 8), (345, 312), (80, 312)]) + rng.uniform(-6, 6, (4, 2))
    lens = Lens((213 + rng.uniform(-15, 15), 160 + rng.uniform(-15, 15)), 266.8, k1, 0.0)
    matrix = cv2.getPerspectiveTransform(lens.ideal(corners).astype(np.float32), far)
    return Projection(np.asarray(matrix, np.float64), lens)


def drawn(rng, true, hidden):
    """A frame of the grid: uneven light, noise, missing and merged dots, debris, a flare, and a covered corner."""
    width, height = SIZE
    v, u = np.mgrid[0:height, 0:width]
    light = np.stack([70 + 0.2 * u, 150 - 0.15 * u + 0.1 * v, 60 + 0.25 * v], -1)
    cells = np.stack(np.meshgrid(np.arange(COLUMNS), np.arange(ROWS)), -1).reshape(-1, 2).astype(float)
    raw = true.raw(cells)
    there = rng.random(len(cells)) > 0.03
    there &= ~((cells[:, 0] >= COLUMNS - hidden[0]) & (cells[:, 1] < hidden[1]))
    ink = np.zeros((height, width), np.uint8)
    for place in raw[there]:
        dot = place + rng.normal(0, 0.15, 2)
        cv2.circle(ink, _fixed(dot), round(2.4 * SCALE), 255, -1, cv2.LINE_AA, 3)
    for first in rng.choice(np.flatnonzero(there), 4):  # ink that ran from one dot to the next
        cv2.line(ink, _fixed(raw[first]), _fixed(raw[min(first + 1, len(raw) - 1)]), 255, 2, cv2.LINE_AA, 3)
    frame = light * (1 - 0.7 * cv2.GaussianBlur(ink, (0, 0), 0.7)[..., None] / 255.0)
    for _ in range(6):
        centre, axes = _fixed(rng.uniform((0, 0), SIZE)), (round(rng.uniform(3, 14)) * SCALE, 4 * SCALE)
        colour = rng.uniform(0, 255, 3).tolist()
        cv2.ellipse(frame, centre, axes, rng.uniform(0, 180), 0, 360, colour, -1, cv2.LINE_AA, 3)
    frame[-24:] += 120 * rng.random((24, width, 1))
    return np.clip(frame + rng.normal(0, 3, frame.shape), 0, 255).astype(np.uint8)


def _fixed(place):
    return tuple(int(value) for value in np.round(np.asarray(place) * SCALE))


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 6))])
@pytest.mark.parametrize(("k1", "hidden"), [(0.0, (0, 0)), (-0.12, (0, 0)), (0.15, (7, 5))])
def test_the_grid_is_found_where_it_truly_is(seed, k1, hidden):
    rng = np.random.default_rng(seed)
    true = projection(rng, k1)
    grid = fit_grid(drawn(rng, true, hidden))
    assert grid is not None
    assert grid.shape == (ROWS, COLUMNS)
    shown = 1 - hidden[0] * hidden[1] / (ROWS * COLUMNS)
    assert grid.present.mean() > shown - 0.16
    assert grid.displaced_n < 0.05 * ROWS * COLUMNS
    nodes = np.argwhere(np.ones(grid.shape, bool))[:, ::-1].astype(float)
    covered = (nodes[:, 0] >= COLUMNS - hidden[0]) & (nodes[:, 1] < hidden[1])
    off = np.linalg.norm(grid.projection.raw(nodes) - true.raw(nodes), axis=1)
    assert np.sqrt(np.square(off[~covered]).mean()) < 0.35
    assert off[covered].max(initial=0) < 3
    assert np.sqrt(np.square(grid.off).sum(1).mean()) * grid.pitch_px < 0.5


@pytest.mark.parametrize("factor", [3, 5])
def test_the_grid_of_a_large_frame_is_where_that_of_a_small_one_is(factor):
    rng = np.random.default_rng(4)
    true = projection(rng, -0.1)
    small = drawn(rng, true, (0, 0))
    grid = fit_grid(cv2.resize(small, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC))
    assert grid is not None
    assert grid.shape == (ROWS, COLUMNS)
    shift = (factor - 1) / 2  # pixel centres
    assert np.sqrt(np.square((grid.raw_px - shift) / factor - true.raw(grid.cells)).sum(1).mean()) < 0.35
    assert np.abs(grid.projection.plane(grid.raw_px) - grid.cells).max() < 0.1
    assert np.allclose(grid.projection.raw(grid.projection.plane(grid.raw_px)), grid.raw_px, atol=0.01)


@pytest.mark.parametrize("seed", range(3))
def test_a_gel_without_markers_shows_no_grid(seed):
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.normal(0, 60, (320, 427, 3)), (0, 0), 5) * 6 + 120
    assert fit_grid(np.clip(noise, 0, 255).astype(np.uint8)) is None


def printed(cells: np.ndarray, ink: float, light: float = 120.0) -> np.ndarray:
    """A frame of round markers at ``cells`` [n, 2], 24 px apart; dark by a share of the light, or lighter below 0."""
    cover = np.zeros((320, 427), np.uint8)
    for place in 24 * cells + 30:
        cv2.circle(cover, _fixed(place), 5 * SCALE, 255, -1, cv2.LINE_AA, 3)
    frame = light * (1 - ink * cv2.GaussianBlur(cover, (0, 0), 0.8) / 255.0)
    noise = np.random.default_rng(0).normal(0, 3, (320, 427, 3))
    return np.clip(frame[..., None] + noise, 0, 255).astype(np.uint8)


CELLS = np.stack(np.meshgrid(np.arange(15), np.arange(11)), -1).reshape(-1, 2).astype(float)
HEXAGONAL = (CELLS + np.stack([CELLS[:, 1] % 2 / 2, np.zeros(len(CELLS))], 1)) * [1, np.sqrt(3) / 2]


def test_the_gaps_between_light_markers_are_no_markers():
    """They form a regular grid, too, at the same or at half the distance."""
    assert fit_grid(printed(CELLS, 0.5)).shape == (11, 15)
    for ink in (-0.3, -0.8):
        assert fit_grid(printed(CELLS, ink)) is None


@pytest.mark.parametrize("beyond", [0.95, 1.05])
@pytest.mark.parametrize("around", [2.0, 40.0])
def test_the_dark_edge_of_a_gel_that_ends_a_pitch_beyond_its_markers_is_none_of_them(beyond: float, around: float):
    """It passes for a ring of them, whose places no lens explains."""
    frame = np.asarray(cv2.copyMakeBorder(printed(CELLS, 0.7), 80, 160, 100, 113, cv2.BORDER_REPLICATE), np.float64)
    first, last = (np.array([130, 110]) + 24 * node for node in (-beyond, np.array([14, 10]) + beyond))
    gel = np.zeros(frame.shape[:2])
    gel[round(first[1]) : round(last[1]), round(first[0]) : round(last[0])] = 1
    gel = cv2.GaussianBlur(gel, (0, 0), 2)[..., None]
    grid = fit_grid((gel * frame + (1 - gel) * around).astype(np.uint8))
    assert grid is not None
    assert (grid.shape, grid.displaced_n) == ((11, 15), 0)
    assert np.abs(grid.raw_px - (24 * grid.cells + [130, 110])).max() < 0.5


@pytest.mark.parametrize(
    ("cells", "ink", "light", "why"),
    [
        (HEXAGONAL, 0.7, 120, "hexagonal"),
        (CELLS, -0.8, 120, "lighter than the gel around them"),
        (CELLS, -15.0, 3, "lighter than the gel around them"),
    ],
)
def test_a_print_that_cannot_be_followed_is_named_and_leaves_no_profile(
    cells: np.ndarray, ink: float, light: float, why: str, tmp_path, capsys
):
    """Offset rows fit a grid well, but rectified to right angles the gel would be sheared."""
    picture, profile = tmp_path / "a.png", tmp_path / "mine.toml"
    cv2.imwrite(str(picture), printed(cells, ink, light))
    assert main(["calibrate", "--picture", str(picture), "--new-profile", str(profile)]) == 2
    assert why in capsys.readouterr().err
    assert not profile.exists()
