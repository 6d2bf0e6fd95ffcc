"""A recorded grasp stops an armed arm where a session would: with the session's settings, not those for clips."""

import numpy as np
import pytest

from service.perception.markers.tracker import MarkerTracker
from service.perception.slip.grasp import GraspWatch
from service.tools.live import stops_of
from tests.service.perception.synthetic import draw, grid

RATE_HZ = 8.0
OPEN_N, HELD_N, PULLED_N = 6, 12, 4
PULL_PX = 4.0  # a frame; four of them carry the patch by more than half a pitch of 15 px


def story(frames=36):
    """Pictures of one finger: open, held at rest, then pulled down until the object slides and stays behind."""
    rng, rest = np.random.default_rng(3), grid(jitter=0.1)
    away = (rest - rest.mean((0, 1))) / 50.0
    bulged = rest + 3.0 * away * np.exp(0.5 - 0.5 * np.square(away).sum(-1, keepdims=True))
    begin = OPEN_N + HELD_N
    for k in range(frames):
        pulled = PULL_PX * np.clip(k - begin + 1, 0, PULLED_N)
        yield draw(rest if k < OPEN_N else bulged + np.array([0.0, pulled]), rng)


@pytest.fixture(scope="module")
def pictures():
    return list(story())


def watched(pictures, held=range(OPEN_N + 3, 36), open_frame=2):
    return stops_of(lambda: zip(pictures, pictures, strict=True), open_frame, held, RATE_HZ)


def test_a_patch_that_stops_moving_stops_an_armed_arm_though_the_watch_for_clips_hears_nothing(pictures):
    live, slid = watched(pictures), OPEN_N + HELD_N + PULLED_N
    assert live["stalled_frames"] == [slid]
    assert live["markers_frames"] == live["imprint_frames"] == live["other_frames"] == live["refused"] == []
    tracker, clips = MarkerTracker(), GraspWatch()
    fields = [tracker.update(image, round(k * 1e9 / RATE_HZ)) for k, image in enumerate(pictures)]
    assert not any(clips.update(field).slip for field in fields)


def test_it_is_armed_at_rest_in_the_held_grasp_alone_and_again_after_a_stop(pictures):
    slid, armed = OPEN_N + HELD_N + PULLED_N, watched(pictures)["armed_frames"]
    assert OPEN_N + 4 <= armed[0] < OPEN_N + HELD_N
    assert slid in armed
    assert slid + 1 not in armed, "the attempt is over"
    assert armed[-1] == len(pictures) - 1
    late = watched(pictures, held=range(slid, 36))
    assert late["stalled_frames"] == [], "nobody armed it before it slid"
    assert min(late["armed_frames"]) > slid


def test_an_open_gel_that_is_recorded_after_the_grasp_is_learnt_before_it(pictures):
    held_first, slid = [*pictures[OPEN_N:], *pictures[:OPEN_N]], HELD_N + PULLED_N
    live = watched(held_first, range(3, len(pictures) - OPEN_N), len(pictures) - 2)
    assert live["refused"] == []
    assert 4 <= live["armed_frames"][0] < HELD_N
    assert live["stalled_frames"] == [slid]


def test_the_cost_is_that_of_the_whole_and_of_its_parts(pictures):
    cost_ms = watched(pictures, held=range(9, 14))["cost_ms"]
    assert set(cost_ms) == {"whole", "rectify", "markers", "slip", "imprint"}
    assert all(0 < low <= middle <= high for low, middle, high in cost_ms.values())


def test_a_gel_that_cannot_have_been_open_is_named(pictures):
    black = [np.zeros_like(pictures[0]), *pictures[1:]]
    assert len(watched(black, open_frame=0)["refused"]) == 2
