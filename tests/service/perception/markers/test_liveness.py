"""Copies of a picture beneath fresh noise against live frames of a gel at rest and in motion."""

import cv2
import numpy as np
import pytest

from service.contract import TactileFrame
from service.perception.markers.field import MarkerField
from service.perception.markers.liveness import TOGETHER, _grain, _shared_motion
from tests.service import drawn

REST_N, ONSET, SLIP_AT, COPIES_N = 8, 12, 18, 6


def observed(pictures, quality):
    finger = drawn.watch()
    observations = []
    for k, picture in enumerate(pictures):
        sent = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1] if quality else None
        pixels = picture if sent is None else np.asarray(cv2.imdecode(sent, 1), np.uint8)
        observations.append(finger.observe(TactileFrame("left", k, k * drawn.PERIOD_NS, pixels)))
    return observations


def new_frames(pictures, quality):
    """Whether each picture was new to the finger."""
    return [one.field.usable for one in observed(pictures, quality)]


def live(count, first=0):
    return [drawn.raw("left", k, ONSET, SLIP_AT) for k in range(first, first + count)]


def copies(original, grey, seed=1):
    noise = np.random.default_rng(seed).integers(-grey, grey + 1, (COPIES_N, *original.shape))
    return list(np.clip(original + noise, 0, 255).astype(np.uint8))


@pytest.mark.parametrize("quality", [None, 80])
def test_live_frames_are_new_at_rest_in_motion_and_in_slip(quality):
    observations = observed(live(SLIP_AT + 6), quality)
    assert all(one.field.usable for one in observations)
    doubted = [k for k, one in enumerate(observations) if one.certain_ns != one.captured_ns]
    assert doubted == [SLIP_AT + 3], "only the first one after a sudden standstill"


@pytest.mark.parametrize(("grey", "quality"), [(2, None), (2, 80), (8, 95)])
@pytest.mark.parametrize("frozen_at", [REST_N, ONSET + 2])
def test_copies_beneath_fresh_noise_are_none_from_the_second_on(frozen_at, grey, quality):
    before = live(frozen_at)
    new = new_frames([*before, *copies(before[-1], grey), *live(4, frozen_at)], quality)
    assert new == [True] * (frozen_at + 1) + [False] * (COPIES_N - 1) + new[-4:]
    assert all(new[-3:]), "a camera that lives again is believed"


@pytest.mark.parametrize(("grey", "quality"), [(1, None), (2, 80), (2, 95)])
@pytest.mark.parametrize("frozen_at", [REST_N, ONSET + 2, SLIP_AT + 1])
def test_only_the_picture_before_the_first_copy_is_certain(frozen_at, grey, quality):
    before = live(frozen_at)
    *_, original, first = observed([*before, *copies(before[-1], grey)[:1]], quality)
    assert first.field.usable
    assert (original.certain_ns, first.certain_ns) == (original.captured_ns, original.captured_ns)


def test_a_doubted_picture_is_made_up_for_by_the_next_one_that_is_new():
    before = live(REST_N)
    *_, doubted, new = observed([*before, *copies(before[-1], 2)[:1], *live(1, REST_N)], None)
    assert doubted.certain_ns < doubted.captured_ns
    assert new.certain_ns == new.captured_ns


def test_a_picture_that_no_grasp_has_changed_is_none_until_it_changes():
    renderer, finger = drawn.renderer("left"), drawn.watch()
    at_rest = np.zeros((20, 21, 3), np.float32)
    finger.learn_open(TactileFrame("left", 0, 0, renderer.raw(at_rest, 500)))
    finger.rearm()
    new = []
    for k, gel in enumerate([at_rest] * 4 + [drawn.gel(0.0)] * 3 + [at_rest] * 3, 1):
        pixels = renderer.raw(gel, 500 + k)
        new.append(finger.observe(TactileFrame("left", k, k * drawn.PERIOD_NS, pixels)).field.usable)
    assert new == [True] + [False] * 3 + [True] * 6, "what lets go later is a release, not a copy"


def test_a_light_grip_that_only_shades_the_gel_is_a_new_picture():
    renderer, finger = drawn.renderer("left"), drawn.watch()
    at_rest = np.zeros((20, 21, 3), np.float32)
    finger.learn_open(TactileFrame("left", 0, 0, renderer.raw(at_rest, 500)))
    finger.rearm()
    shape = renderer.raw(at_rest, 501).shape[:2]
    v, u = (np.linspace(-2.0, 2.0, size) for size in shape)
    shade = 25.0 * np.exp(-np.square(v)[:, None] - np.square(u))[..., None]  # far too smooth for the grain
    for k in range(1, 6):
        picture = np.clip(renderer.raw(at_rest, 500 + k) + shade, 0, 255).astype(np.uint8)
        observation = finger.observe(TactileFrame("left", k, k * drawn.PERIOD_NS, picture))
        assert (observation.bulge or 0.0) < 1.0
        assert observation.field.usable


def test_a_light_grip_that_hardly_moves_the_markers_is_a_new_picture():
    """By 0.7 of what counts as touched, of which a noisy picture's grain shows nothing."""
    renderer, finger = drawn.renderer("left"), drawn.watch()
    gripped = np.zeros((20, 21, 3), np.float32)
    noise = np.random.default_rng(0)

    def frame(k, gel):
        clean = renderer.raw(gel, 500)
        picture = np.clip(np.rint(clean + noise.normal(0.0, 6.0, clean.shape)), 0, 255).astype(np.uint8)
        return TactileFrame("left", k, k * drawn.PERIOD_NS, picture)

    finger.learn_open(frame(0, gripped))
    finger.rearm()
    gripped = gripped + np.array([0.0125, 0.0, 0.0], np.float32)
    for k in range(1, 6):
        observation = finger.observe(frame(k, gripped))
        assert observation.bulge == pytest.approx(0.7, abs=0.15)
        assert observation.field.usable


@pytest.mark.parametrize("pressed_mm", [(0.05, 0.06), (0.12, 0.16)])
def test_an_object_that_hangs_free_again_is_a_new_picture_after_a_press(pressed_mm):
    renderer, finger = drawn.renderer("left"), drawn.watch()
    for k, shift_mm in enumerate((0.0, *pressed_mm, 0.0)):
        if shift_mm == 0.0:
            finger.rearm()  # no frame is looked at while the arm goes up
        pixels = renderer.raw(drawn.gel(shift_mm), 500 + k)
        assert finger.observe(TactileFrame("left", k, k * drawn.PERIOD_NS, pixels)).field.usable


def shown(moved_px: np.ndarray, valid: np.ndarray | None = None) -> MarkerField:
    there = np.ones(moved_px.shape[:2], np.bool_) if valid is None else valid
    return MarkerField(np.zeros_like(moved_px), moved_px.astype(np.float32), there, None, 15.0, 0)


@pytest.mark.parametrize("size_px", [1e-3, 1.0, 40.0])
def test_markers_that_move_as_one_share_their_motion_and_errors_share_none(size_px):
    """Whatever the size of either, and wherever markers are hidden."""
    rest, rng = shown(np.zeros((20, 21, 2))), np.random.default_rng(0)
    hidden = rng.random((20, 21)) < 0.2
    errors, chequered = rng.normal(0, 1, (20, 21, 2)), (-1.0) ** np.indices((20, 21)).sum(0)[..., None]
    for valid in (None, ~hidden):
        assert _shared_motion(rest, shown(size_px * np.ones((20, 21, 2)), valid)) == pytest.approx(1.0)
        assert abs(_shared_motion(rest, shown(size_px * errors, valid))) < TOGETHER
        assert _shared_motion(rest, shown(size_px * chequered * np.ones(2), valid)) == pytest.approx(-1.0)
    below_px = size_px * np.where(np.arange(20) < 10, 0.0, 1.0)[:, None, None] * np.ones((20, 21, 2))
    assert _shared_motion(rest, shown(below_px)) == pytest.approx(
        (9 * 21 + 10 * 20) / (19 * 21 + 20 * 20) * 420 / 210
    ), "the pairs that move, of all pairs, beside the markers that move, of all"


def test_what_does_not_move_or_cannot_be_compared_shares_nothing():
    rest = shown(np.zeros((20, 21, 2)))
    assert _shared_motion(rest, rest) == 0.0
    assert _shared_motion(None, rest) == 0.0
    assert _shared_motion(shown(np.zeros((7, 9, 2))), rest) == 0.0
    alone = np.zeros((20, 21), np.bool_)
    alone[::2, ::2] = True
    assert _shared_motion(rest, shown(np.ones((20, 21, 2)), alone)) == 0.0


def test_the_grain_is_the_same_in_another_light_and_whatever_lies_around_the_middle():
    picture = drawn.raw("left", 0, ONSET, SLIP_AT)
    height, width = picture.shape[:2]
    grain = _grain(picture)
    noise = float(np.square(grain - _grain(drawn.raw("left", 1, ONSET, SLIP_AT))).mean())
    shade = 20.0 + 10.0 * np.linspace(-1.0, 1.0, height)[:, None, None] * np.linspace(-1.0, 1.0, width)[:, None]
    lit = np.clip(np.rint(0.7 * picture + shade), 0, 255).astype(np.uint8)
    dimmed = np.clip(np.rint(0.7 * picture), 0, 255).astype(np.uint8)
    assert np.square(_grain(lit) - _grain(dimmed)).mean() < 0.1 * noise
    around = np.full_like(picture, 7)
    middle = np.s_[height // 4 : -(height // 4), width // 4 : -(width // 4)]
    around[middle] = picture[middle]
    assert np.array_equal(_grain(around), grain)
