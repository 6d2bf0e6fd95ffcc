"""Rare cases: every one ends in a typed result with finite numbers, never in an exception."""

import numpy as np
import pytest

from service.perception.markers.tracker import MarkerTracker
from service.perception.slip.detector import SlipDetector
from service.perception.slip.grasp import GraspWatch
from service.perception.slip.onset import OnsetDetector
from tests.service.perception.synthetic import FRAME_NS, draw, grid, hard_image

REST = grid()


CASES = ["black", "white", "noise", "saturated", "covered", "twist", "twist 90", "jump 1.6 pitch", "merged"]
CASES += ["line", "three", "none", "scattered"]


@pytest.mark.parametrize("case", CASES)
def test_any_frame_gives_a_typed_and_finite_result_and_the_grid_comes_back(case):
    rng = np.random.default_rng(11)
    tracker, slip, onset, watch = MarkerTracker(), SlipDetector(), OnsetDetector(), GraspWatch()
    first = tracker.update(draw(REST, rng), 0)
    slip.rearm(first)
    onset.rearm(first)
    images = [hard_image(case, rng), hard_image(case, rng), None, draw(REST, rng), draw(REST, rng)]
    for k, image in enumerate(images, 1):
        field = tracker.update(image, k * FRAME_NS)
        state = slip.update(field)
        onset.update(field)
        watch.update(field)
        assert np.isfinite(field.displacement_px).all()
        assert np.isfinite(state.residual_px).all()
        assert np.isfinite([state.score, state.angle_rad, state.scale, *state.shift_px]).all()
    error = np.linalg.norm(field.displacement_px, axis=-1)
    assert field.status == "tracking"
    assert (field.valid & (error < 1.0)).mean() > 0.97


@pytest.mark.parametrize("case", CASES)
def test_any_first_frame_is_survived(case):
    rng = np.random.default_rng(12)
    tracker, slip = MarkerTracker(), SlipDetector()
    for k in range(3):
        field = tracker.update(hard_image(case, rng), k * FRAME_NS)
        assert np.isfinite(field.displacement_px).all()
        assert slip.rearm(field).state in {"hold", "unknown"}
        assert np.isfinite(slip.update(field).score)


def test_dropped_frames_lose_no_marker():
    rng = np.random.default_rng(13)
    tracker = MarkerTracker()
    for k in (0, 1, 5, 6, 12):  # up to five frames missing while the patch goes on by 2.5 px a frame
        truth = REST + np.array([0.0, 2.5 * k]) * np.exp(-np.square(REST - 160).sum(-1) / 2 / 70**2)[..., None]
        field = tracker.update(draw(truth, rng), k * FRAME_NS)
        error = np.linalg.norm(field.rest_px + field.displacement_px - truth, axis=-1)
        assert (field.valid & (error < 3)).mean() > 0.99
