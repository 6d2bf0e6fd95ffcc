"""The open gel is found among frames that do not say what they show, and is not made up where there is none."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from service.perception.slip.open_gel import shrunk
from service.tools.open_frame import open_frame

OPEN = cv2.GaussianBlur(np.random.default_rng(8).uniform(90, 160, (240, 320, 3)), (0, 0), 25).astype(np.float32)


def pictures(touched, rng, walk_px=0):
    """Frames of one gel, float 0 .. 1 of a ridge's height each; the ridge walks sideways by ``walk_px`` a frame."""
    for k, height in enumerate(touched):
        gel = OPEN + rng.normal(0, 2, OPEN.shape)
        left = 100 + k * walk_px
        gel[60:180, left : left + 8] += 60 * height
        gel[60:180, left + 8 : left + 16] -= 60 * height
        yield np.rint(shrunk(np.clip(gel, 0, 255).astype(np.uint8))).astype(np.uint8)


@pytest.mark.parametrize("seed", range(3))
def test_the_open_frame_is_found_before_a_grasp_and_after_one(seed):
    rng = np.random.default_rng(seed)
    before = [0.0] * 20 + [0.3, 0.6] + [1.0] * 60
    after = [*before[::-1], *[0.0] * 20]
    for story in (before, after):
        found = open_frame([list(pictures(story, rng)), list(pictures(story, rng))])
        assert found.is_open
        assert story[found.frame] == 0.0


def test_a_gel_touched_all_along_is_not_called_open():
    rng = np.random.default_rng(4)
    assert open_frame([list(pictures([1.0] * 60, rng, walk_px=3)) for _ in range(2)]).is_open is False


def test_a_gel_that_never_changes_is_left_open():
    rng = np.random.default_rng(5)
    assert open_frame([list(pictures([0.0] * 60, rng))]).is_open is None


def test_the_labels_of_real_runs_are_in_order():
    labels = json.loads((Path(__file__).parent / "real_slips.json").read_text())
    assert labels["how"]
    assert labels["check"]
    for run, label in labels["slip"].items():
        seen = [frame for frame in (label["contact"], label["slide"], label["lost"]) if frame is not None]
        assert seen == sorted(seen), run
        assert run.endswith("_slip")
    assert all(run.endswith("_hold") for run in labels["held"])
