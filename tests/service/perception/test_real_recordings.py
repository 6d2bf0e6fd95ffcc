"""On sensors we did not make: GelSlim 3 (screen recording) and GelSight Mini (two fingers of a gripper)."""

import numpy as np
import pytest

from service.perception.grasp import GraspWatch
from service.perception.markers import MarkerTracker
from tests.service.perception.real import GELSLIM_CROP, read_video, real_data

pytestmark = pytest.mark.real_data
CONTACT_FREE = [(3, 26), (99, 104), (188, 201), (293, 331), (423, 475), (603, 613), (643, 716)]


@pytest.mark.slow
def test_gelslim3_markers_come_home_after_every_press():
    """At most 1 % of all markers more than a quarter pitch off whenever nothing touches the gel, to the end."""
    folder = real_data("gelslim3_press")
    tracker = MarkerTracker()
    frames = read_video(folder / "sample_realtime_depth.mp4", GELSLIM_CROP)
    fields = [tracker.update(frame, round(k * 1e9 / 15)) for k, frame in enumerate(frames)]
    assert len(fields) == 717
    for interval in CONTACT_FREE:
        for k in interval:
            off = np.linalg.norm(fields[k].displacement_px, axis=-1) / fields[k].pitch_px
            assert (off > 0.25).mean() <= 0.01
            assert np.median(off) < 0.02


def test_gelsight_mini_markers_are_found_in_every_clip():
    folder = real_data("gelsight_mini_slip")
    for clip in sorted(folder.glob("*/camera_*.avi"))[::6]:
        tracker = MarkerTracker()
        fields = [tracker.update(frame, k * 125_000_000) for k, frame in enumerate(read_video(clip)[:60])]
        assert min(tracker.grid_shape) >= 5
        assert all(field.status == "tracking" for field in fields)
        assert np.mean([field.valid.mean() for field in fields]) > 0.8


@pytest.mark.slow
def test_no_slip_is_announced_while_a_real_object_is_held_and_shaken():
    """22 finger clips of held objects, from after the grasp to before the release; tuned on these, so a regression.

    Judged out of sample by `python -m simulation slip-report --real`.
    """
    folder = real_data("gelsight_mini_slip")
    alarms, frames = 0, 0
    for clip in sorted(folder.glob("*_hold/camera_*.avi")):
        tracker, watch = MarkerTracker(), GraspWatch()
        images = read_video(clip)
        states = [watch.update(tracker.update(image, k * 125_000_000)) for k, image in enumerate(images)]
        judged = states[45:-30]
        alarms += sum(state.slip for state in judged)
        frames += len(judged)
    assert frames > 3000
    assert alarms / frames * 1500 <= 0.2
