"""Markers are found where they are drawn, at every scale, light and size of picture."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.perception.markers.detect import MarkerDetector
from tests.service.perception.synthetic import draw, grid


def alone(x: float, y: float, diameter: float, **options: float) -> np.ndarray:
    return draw(np.array([[x, y]]), np.random.default_rng(0), 160, 120, diameter, **options)


@given(st.floats(60.0, 90.0), st.floats(45.0, 75.0), st.sampled_from([(5.0, 1), (9.0, 1), (14.0, 2), (25.0, 4)]))
def test_a_marker_is_found_to_a_hundredth_of_its_diameter(x: float, y: float, size: tuple[float, int]) -> None:
    diameter, shrink = size
    spots = MarkerDetector(diameter, 2.6 * diameter, shrink).detect(alone(x, y, diameter, noise=0.0), 20.0)
    assert len(spots.xy_px) == 1
    assert spots.xy_px[0] == pytest.approx((x, y), abs=max(0.04, 0.012 * diameter))


def test_the_strongest_comes_first_and_those_at_the_edge_or_below_the_threshold_not_at_all() -> None:
    rng = np.random.default_rng(1)
    image = draw(np.array([[40.0, 60.0], [0.2, 20.0]]), rng, 160, 120, contrast=60.0, noise=0.0)
    dark = draw(np.array([[100.0, 60.0]]), rng, 160, 120, contrast=100.0, noise=0.0)
    spots = MarkerDetector(5.0, 15.0).detect(np.minimum(image, dark), 20.0)
    assert spots.xy_px == pytest.approx(np.array([[100.0, 60.0], [40.0, 60.0]]), abs=0.05)
    assert spots.strength[0] == pytest.approx(spots.strength[1] * 100 / 60, rel=0.1)
    between = float(spots.strength.mean())
    assert len(MarkerDetector(5.0, 15.0).detect(np.minimum(image, dark), between).xy_px) == 1


def test_light_that_falls_off_or_brightens_moves_no_marker() -> None:
    points = grid(8, 8, 18.0, 160, 160)
    detector = MarkerDetector(6.0, 18.0)
    plain = detector.detect(draw(points, np.random.default_rng(0), 160, 160, 6.0, noise=0.0), 20.0).xy_px
    slope = np.linspace(0.6, 1.0, 160)[None, :, None]
    image = (draw(points, np.random.default_rng(0), 160, 160, 6.0, noise=0.0) * slope).astype(np.uint8)
    falling = detector.detect(image, 10.0).xy_px
    apart = np.linalg.norm(falling[:, None] - plain[None], axis=-1).min(1)
    assert len(falling) == len(plain) == 64
    assert apart.max() < 0.12


def test_a_smeared_marker_is_less_tight_than_a_round_one() -> None:
    rng = np.random.default_rng(0)
    smeared = draw(np.array([[75.0, 60.0], [80.0, 60.0], [85.0, 60.0]]), rng, 160, 120, noise=0.0)
    detector = MarkerDetector(5.0, 30.0)
    (round_one,) = detector.detect(alone(80.0, 60.0, 5.0, noise=0.0), 20.0).tightness
    assert detector.detect(smeared, 20.0).tightness[0] < 0.4 * round_one
    assert detector.detect(alone(80.0, 60.0, 5.0, contrast=45.0, noise=0.0), 10.0).tightness == pytest.approx(
        [round_one], rel=0.1
    )


def test_a_picture_is_read_as_large_as_it_is_unless_it_is_shrunk() -> None:
    image = alone(70.0, 60.0, 12.0)
    assert MarkerDetector(12.0, 32.0).response(image).shape == (120, 160)
    assert MarkerDetector(12.0, 32.0, 3).response(image).shape == (40, 53), "what is left at the border is cut off"


@pytest.mark.parametrize("shrink", [1, 2])
def test_a_grey_picture_is_read_as_a_coloured_one(shrink: int) -> None:
    image = alone(70.0, 60.0, 12.0)
    grey = np.repeat(image[..., 1:2], 3, 2)
    detector = MarkerDetector(12.0, 32.0, shrink)
    assert np.array_equal(detector.response(grey[..., 0]), detector.response(np.ascontiguousarray(grey)))


@given(st.integers(0, 1000), st.integers(1, 4))
def test_a_marker_lies_at_the_top_of_the_paraboloid_through_nine_pixels_a_pixel_aside_at_most(
    seed: int, shrink: int
) -> None:
    """Where they have no top, in their middle; its tightness is the least curvature, as a share of its height."""
    response = np.random.default_rng(seed).uniform(1.0, 2.0, (9, 12)).astype(np.float32)
    cells = [(2, 3), (5, 8), (7, 10)]
    spots = MarkerDetector(5.0, 15.0, shrink)._refine(response, np.array([row * 12 + column for row, column in cells]))
    dy, dx = np.mgrid[-1:2, -1:2].reshape(2, -1)
    terms = np.stack([np.ones(9), dx, dy, dx * dx, dx * dy, dy * dy], -1)
    for k, (row, column) in enumerate(cells):
        nine = response[row - 1 : row + 2, column - 1 : column + 2].ravel()
        _, gx, gy, xx, xy, yy = np.linalg.lstsq(terms, nine, rcond=None)[0]
        bend = np.array([[2 * xx, xy], [xy, 2 * yy]])
        top = np.clip(-np.linalg.solve(bend, [gx, gy]), -1, 1) if np.linalg.det(bend) > 1e-9 else np.zeros(2)
        at_px = (np.array([column, row]) + top + 0.5) * shrink - 0.5
        assert spots.xy_px[k] == pytest.approx(at_px, abs=1e-2 * shrink)
        assert spots.strength[k] == response[row, column]
        assert spots.tightness[k] == pytest.approx(-np.linalg.eigvalsh(bend)[-1] / response[row, column], abs=1e-4)
