"""The renderer: dots go where the gel goes, the lens is undone, the same seed gives the same bits."""

import dataclasses
from unittest import mock

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from service.contract import Sensor
from simulation.optics.renderer import Appearance, Renderer

SENSOR = Sensor.load()

QUIET = dataclasses.replace(
    Appearance(), noise_sigma_grey=0.0, missing_dots_share=0.0, cloth_contrast=0.0, worn=0.0, object_texture_gain=0.0
)
REST_MM = 0.07 * (SENSOR.marker_rest_px() - np.array([163.0, 159.5]))


def still() -> NDArray[np.float64]:
    return np.zeros((20, 21, 3))


def turned(angle_rad: float, pressure: float = 0.05) -> NDArray[np.float64]:
    """Gel carried by a rigid rotation about the image centre, fading towards the rim."""
    rotation = np.array([[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]])
    fade = np.exp(-((np.linalg.norm(REST_MM, axis=-1) / 9.0) ** 6))[..., None]
    gel = still()
    gel[..., :2] = (REST_MM @ rotation.T - REST_MM) * fade
    gel[..., 2:] = pressure * fade
    return gel


def dot_centres(frame: NDArray[np.uint8], expected_px: NDArray[np.floating]) -> NDArray[np.float64]:
    """Darkness-weighted centroid within 6 px of where each dot is expected."""
    dark = 255.0 - frame.astype(float).mean(-1)
    centres = np.empty_like(expected_px, dtype=float)
    for index in np.ndindex(*expected_px.shape[:2]):
        u, v = np.rint(expected_px[index]).astype(int)
        rows, columns = np.mgrid[v - 6 : v + 7, u - 6 : u + 7]
        patch = dark[v - 6 : v + 7, u - 6 : u + 7]
        weight = np.clip(patch - np.median(patch) - 12, 0, None)
        centres[index] = (weight * columns).sum() / weight.sum(), (weight * rows).sum() / weight.sum()
    return centres


def test_dots_at_rest_are_where_the_contract_puts_them() -> None:
    frame = Renderer(QUIET).rectified(still(), 0)
    error = dot_centres(frame, SENSOR.marker_rest_px()) - SENSOR.marker_rest_px()
    assert np.sqrt((error**2).mean()) < 0.06
    assert np.abs(error).max() < 0.5


@settings(max_examples=10, deadline=None)
@given(du=st.floats(-0.4, 0.4), dv=st.floats(-0.25, 0.25))
def test_dots_follow_a_shift_of_the_gel(du: float, dv: float) -> None:
    gel = still()
    gel[..., 0], gel[..., 1] = du, dv
    expected = SENSOR.marker_rest_px() + np.array([du, dv], np.float32) / 0.07
    error = dot_centres(Renderer(QUIET).rectified(gel, 0), expected) - expected
    assert np.sqrt((error**2).mean()) < 0.15


@pytest.mark.parametrize("angle_deg", [-6.0, 2.0, 6.0])
def test_a_tilt_in_the_hand_turns_the_dots(angle_deg: float) -> None:
    gel = turned(np.deg2rad(angle_deg))
    expected = SENSOR.marker_rest_px() + gel[..., :2] / 0.07
    error = dot_centres(Renderer(QUIET).rectified(gel, 0), expected) - expected
    assert np.sqrt((error**2).mean()) < 0.2


def test_the_homography_undoes_the_lens() -> None:
    renderer = Renderer(QUIET)
    corners = np.array(QUIET.corners_raw_px)[None].astype(float)
    flat = cv2.perspectiveTransform(corners, renderer.homography)[0]
    assert np.allclose(flat, [[0, 0], [326, 0], [326, 319], [0, 319]], atol=1e-3)


def test_rectified_is_the_warped_raw_frame() -> None:
    renderer = Renderer(Appearance())
    raw = renderer.raw(turned(0.05), 7)
    assert raw.shape == (320, 427, 3)
    assert raw.dtype == np.uint8
    expected = cv2.warpPerspective(raw, renderer.homography, (327, 320))
    assert np.array_equal(renderer.rectified(turned(0.05), 7), expected)


def test_same_seed_same_bits_and_other_seed_other_noise() -> None:
    gel = turned(0.03)
    first, second = Renderer(Appearance(seed=5)), Renderer(Appearance(seed=5))
    assert np.array_equal(first.raw(gel, 1), second.raw(gel, 1))
    assert not np.array_equal(first.raw(gel, 1), first.raw(gel, 2))


def test_calls_do_not_depend_on_what_was_drawn_before() -> None:
    renderer = Renderer(Appearance())
    alone = renderer.raw(turned(0.03), 1)
    renderer.raw(turned(-0.1), 9)
    assert np.array_equal(renderer.raw(turned(0.03), 1), alone)


def test_gel_that_did_not_move_is_lit_once_and_grained_anew() -> None:
    look = dataclasses.replace(Appearance(), motion_blur_share=0.5)
    renderer, gel = Renderer(look), turned(0.03)
    with mock.patch.object(Renderer, "_lit", autospec=True, side_effect=Renderer._lit) as lit:
        frames = [renderer.raw(gel, seed, gel) for seed in (1, 2)]
        assert lit.call_count == 1
        renderer.raw(gel, 3, still())
        renderer.raw(turned(0.04), 4, gel)
        assert lit.call_count == 3
    for seed, frame in zip((1, 2), frames, strict=True):
        assert np.array_equal(frame, Renderer(look).raw(gel, seed))
    assert not np.array_equal(*frames)


@pytest.mark.parametrize("sigma", [2.0, 4.0, 6.0])
def test_noise_has_the_stated_spread(sigma: float) -> None:
    renderer = Renderer(dataclasses.replace(Appearance(), noise_sigma_grey=sigma))
    difference = renderer.raw(still(), 1).astype(float) - renderer.raw(still(), 2)
    bright = (renderer.raw(still(), 3) > 60) & (renderer.raw(still(), 3) < 200)
    assert np.std(difference[bright]) == pytest.approx(np.sqrt(2) * sigma, rel=0.05)


def test_yaw_of_the_object_shows_as_a_change_of_light_without_motion() -> None:
    renderer = Renderer(QUIET)
    flat, leaning = still(), still()
    flat[..., 2] = 0.05
    leaning[..., 2] = 0.05 * (1 + 0.8 * np.linspace(-1, 1, 21))
    change = renderer.rectified(leaning, 0).astype(float) - renderer.rectified(flat, 0)
    red, green = change[40:280, 40:280, 2].mean(), change[40:280, 40:280, 1].mean()
    assert red > 1.0
    assert green < -1.0


def test_light_changes_smoothly_where_pressure_does() -> None:
    gel = still()
    gel[..., 2] = 0.05 * np.exp(-((REST_MM / 5.0) ** 2).sum(-1))
    frame = Renderer(dataclasses.replace(QUIET, dot_darkness=0.0)).raw(gel, 0).astype(float)
    inside = frame[20:300, 125:300]
    assert np.abs(np.diff(inside, axis=1)).max() < 6
    assert np.abs(np.diff(inside, n=2, axis=1)).max() < 6


def test_held_texture_appears_only_in_contact() -> None:
    look = dataclasses.replace(QUIET, object_texture="layers", object_texture_gain=0.2)
    renderer, bare = Renderer(look), Renderer(QUIET)
    touching = still()
    touching[..., 2] = 0.05
    assert np.array_equal(renderer.raw(still(), 0), bare.raw(still(), 0))
    assert np.abs(renderer.raw(touching, 0).astype(float) - bare.raw(touching, 0)).mean() > 1


def test_motion_blur_smears_along_the_motion() -> None:
    renderer = Renderer(dataclasses.replace(QUIET, motion_blur_share=1.0))
    moved = still()
    moved[..., 0] = 0.2
    sharp, smeared = renderer.rectified(moved, 0), renderer.rectified(moved, 0, still())
    middle = SENSOR.marker_rest_px() + np.array([0.1 / 0.07, 0], np.float32)
    assert np.abs(dot_centres(smeared, middle) - middle)[..., 0].mean() < 0.3
    assert smeared.min() > sharp.min()


def test_the_rolling_shutter_shows_the_top_rows_earlier() -> None:
    moved = still()
    moved[..., 0] = 0.2
    rolling = Renderer(dataclasses.replace(QUIET, rolling_share=1.0))
    expected = SENSOR.marker_rest_px() + np.array([0.2 / 0.07, 0], np.float32)
    lag = (expected - dot_centres(rolling.rectified(moved, 0, still()), expected))[..., 0].mean(1)
    assert lag[0] > 0.8 * 0.2 / 0.07
    assert lag[-1] < 0.35
    assert np.all(np.diff(lag) < 0.1)
    assert np.array_equal(rolling.rectified(moved, 0), Renderer(QUIET).rectified(moved, 0))


@pytest.mark.parametrize(("shape", "value"), [((20, 20, 3), 0.0), ((20, 21, 3), np.nan), ((20, 21, 3), np.inf)])
def test_a_gel_state_that_is_not_one_is_refused(shape: tuple[int, ...], value: float) -> None:
    with pytest.raises(ValueError, match="gel state"):
        Renderer(QUIET).raw(np.full(shape, value), 0)
