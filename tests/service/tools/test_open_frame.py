"""The open gel is found among unlabelled frames, and is not invented where there is none."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from service.perception.markers.field import MarkerField
from service.perception.markers.regular import irregular_pitch
from service.tools.open_frame import rest
from tests.service.perception.synthetic import grid

LIGHT = np.add.outer(np.linspace(90, 150, 60), np.linspace(0, 20, 80))[..., None] * np.ones(3)
REST = grid(7, 9, 32.0, 320, 240, jitter=0.2)


def finger(touched, rng, walk_px=0.0, dome=1.0):
    """Pictures and fields of one gel, frame by frame; a ridge, 0 .. 1 high, on a ``dome``; it walks by ``walk_px``."""
    pictures, fields = [], []
    for k, height in enumerate(touched):
        middle = np.array([120.0 + k * walk_px, 110.0])
        away = (REST - middle) / 60.0
        bulge = dome * height * 8.0 * away * np.exp(-np.square(away).sum(-1, keepdims=True))
        picture = LIGHT + rng.normal(0, 0.6, LIGHT.shape)
        left = int(middle[0] // 4)
        picture[15:45, left : left + 2] += 40 * height
        picture[15:45, left + 2 : left + 4] -= 40 * height
        pictures.append(np.clip(picture, 0, 255).astype(np.uint8))
        points = (REST + bulge + rng.normal(0, 0.05, REST.shape)).astype(np.float32)
        valid = np.ones(REST.shape[:2], np.bool_)
        fields.append(MarkerField(points, np.zeros_like(points), valid, None, 32.0, k))
    return pictures, fields


def at_rest(story, rng, **how):
    return rest(*zip(*[finger(story, rng, **how) for _ in range(2)], strict=True))


@pytest.mark.parametrize("seed", range(3))
def test_the_open_frame_is_found_before_a_grasp_and_after_one(seed):
    rng = np.random.default_rng(seed)
    before = [0.0] * 20 + [0.3, 0.6] + [1.0] * 60
    for story in (before, [*before[::-1], *[0.0] * 20]):
        still = at_rest(story, rng)
        assert still is not None
        assert still.is_open
        assert story[still.frame] == 0.0


def test_a_gel_touched_all_along_is_not_called_open_even_where_the_touch_walks_away_and_comes_back():
    rng = np.random.default_rng(4)
    assert not at_rest([1.0] * 60, rng, walk_px=3.0).is_open
    lighter = [1.0] * 20 + [0.4] * 20 + [1.0] * 20
    still = at_rest(lighter, rng, dome=2.0)
    assert not still.is_open
    assert lighter[still.frame] == 0.4, "the zero of the loads is where they are least"


@pytest.mark.parametrize("frames_n", [8, 9, 10])
def test_no_frame_of_a_few_is_taken_as_open_where_none_has_neighbours_to_compare(frames_n):
    assert at_rest([0.0] * frames_n, np.random.default_rng(0)) is None


def test_repeated_frames_hide_no_open_gel_and_make_none():
    rng = np.random.default_rng(1)
    pictures, fields = finger([0.0] * 30 + [1.0] * 30, rng)
    shown = [k for k in range(60) for _ in range(2)]
    repeated = [replace(fields[k], status="duplicate") if n % 2 else fields[k] for n, k in enumerate(shown)]
    still = rest([[pictures[k] for k in shown]] * 2, [repeated] * 2)
    assert still is not None
    assert still.is_open
    assert still.frame < 60
    alone = [replace(field, status="lost") if k % 2 else field for k, field in enumerate(fields)]
    assert rest([pictures] * 2, [alone] * 2) is None, "of no frame the neighbours are known"


def test_a_lens_and_a_camera_at_an_angle_leave_a_print_regular():
    away = (REST - [160.0, 120.0]) / 160.0
    bent = REST - 12.0 * away * np.square(away).sum(-1, keepdims=True) + 4.0 * away[..., :1] * away
    nothing = np.zeros_like(REST, np.float32)
    valid = np.ones(REST.shape[:2], np.bool_)
    assert irregular_pitch(MarkerField(bent.astype(np.float32), nothing, valid, None, 32.0, 0)) < 0.01
    few = MarkerField(bent.astype(np.float32), nothing, valid & (np.arange(9) < 2), None, 32.0, 0)
    assert irregular_pitch(few) == np.inf


def test_the_labels_of_real_runs_are_in_order():
    labels = json.loads((Path(__file__).parent / "real_slips.json").read_text())
    assert labels["how"]
    assert labels["check"]
    for run, label in labels["slip"].items():
        frames = [frame for frame in (label["contact"], label["slide"], label["lost"]) if frame is not None]
        assert frames == sorted(frames), run
        assert run.endswith("_slip")
    assert all(run.endswith("_hold") for run in (*labels["held"], *labels["set_down"]))
    for run in labels["held"].keys() & labels["set_down"].keys():
        frames = [labels["held"][run]["slide"], labels["set_down"][run], labels["held"][run]["emptied"]]
        known = [frame for frame in frames if frame is not None]
        assert known == sorted(known), run
