"""What a recording shows when it is played back: both fingers, the curves and the events, at one moment."""

import json
from pathlib import Path

import numpy as np
import pytest

from service.cameras.capture import CameraFrame
from service.contract import TactileFrame
from service.recordings.schemas import Markers
from service.recordings.writer import Recorder
from service.web.page.playback import Curves, moment, timeline
from tests.service import drawn

PAIR = {"rows": 1, "cols": 2, "rest_px": [0, 0, 20, 0], "displacement_px": [0] * 4}
TRACKED = Markers(**PAIR, valid=b"\1\1").SerializeToString()
UNTRACKED = {
    "no marker is visible": Markers(**PAIR, valid=b"\0\0").SerializeToString(),
    "no grid was found": Markers().SerializeToString(),
}


def moments_ms(curves: Curves) -> list[tuple[int | None, ...]]:
    """The stamps of both fingers at each moment."""
    moments = curves.as_json()["moments"]
    assert all(one["t"] >= 0.0 for one in moments)
    return [tuple(one[f] and int(one[f]) // 10**6 for f in ("left", "right")) for one in moments]


def test_both_fingers_are_played_back_as_they_were_at_the_same_time() -> None:
    """The right camera is 1 ms ahead: after an attempt's last picture its next one is of the attempt that follows."""
    curves = Curves()
    for at_ms in (0, 60, 120, 9000, 9060):
        curves.markers("left", at_ms * 1_000_000, TRACKED)
        curves.markers("right", (at_ms - 1) * 1_000_000, TRACKED)
    assert moments_ms(curves) == [(0, -1), (60, 59), (120, 119), (9000, 8999), (9060, 9059)]


@pytest.mark.parametrize("gone", ["left", "right"])
def test_of_a_finger_whose_camera_failed_no_earlier_picture_is_offered_and_no_moment_is_left_out(gone: str) -> None:
    curves = Curves()
    for at_ms in (0, 60, 120, 180):
        for finger in ("left", "right"):
            if finger != gone or at_ms < 100:
                curves.markers(finger, at_ms * 1_000_000, TRACKED)
    shown = moments_ms(curves)
    alone = [(None, at_ms) if gone == "left" else (at_ms, None) for at_ms in (120, 180)]
    assert shown == [(0, 0), (60, 60), *alone]


@pytest.mark.parametrize("lost", UNTRACKED.values(), ids=UNTRACKED)
def test_pictures_whose_markers_were_lost_are_played_back_and_have_no_slip(lost: bytes) -> None:
    curves = Curves()
    for at_ms, markers in ((0, lost), (60, TRACKED), (120, lost)):
        for finger in ("left", "right"):
            curves.markers(finger, at_ms * 1_000_000, markers)
    assert moments_ms(curves) == [(0, 0), (60, 60), (120, 120)]
    assert [curves.as_json()["slip"][finger][0] for finger in ("left", "right")] == [[0.06], [0.06]]


def test_a_finger_that_shows_no_grid_is_played_back_in_the_dark_as_it_was(tmp_path: Path) -> None:
    frame = TactileFrame("left", 0, 10**9, np.zeros((320, 327, 3), np.uint8))
    recorder = Recorder(tmp_path, "dark", {"calibration": ""})
    recorder.frame(CameraFrame(frame, None))
    recorder.observation(drawn.watch().observe(frame))
    path = recorder.close({"outcome": "failed"})
    (only,) = timeline(path)["moments"]
    assert only["right"] is None
    felt = moment(path, "left", int(only["left"]))
    assert (felt["width"], felt["state"], felt["kinds"]) == (327, "unknown", [])
    assert json.dumps(felt, allow_nan=False)
