"""Real recordings, stored in other ways than they were: the judge finds the same grasps in them."""

from collections.abc import Callable
from pathlib import Path

import cv2
import pytest

from service.tools.judge import report_of, watched
from tests.service.perception.real import read_video, real_data

PHASES = ("contact_frame", "hold_frame", "lost_frame")


def run_of(name: str) -> Path:
    return real_data("gelsight_mini_slip") / name


def stored(run: Path, folder: Path, times: Callable[[int], int], size: tuple[int, int] | None = None) -> Path:
    """The run without loss of detail, with each frame as often as ``times`` says, at this width and height."""
    folder.mkdir()
    for clip in sorted(run.glob("*.avi")):
        frames = [image if size is None else cv2.resize(image, size) for image in read_video(clip)]
        out = cv2.VideoWriter(str(folder / clip.name), cv2.VideoWriter_fourcc(*"FFV1"), 25, frames[0].shape[1::-1])
        for k, image in enumerate(frames):
            for _ in range(times(k)):
                out.write(image)
        out.release()
    return folder


@pytest.mark.real_data
@pytest.mark.parametrize(("times", "longer"), [(lambda k: 1 + (k % 3 == 2), 4 / 3), (lambda _: 2, 2.0)])
def test_a_recorder_that_stores_frames_twice_changes_no_phase(tmp_path, times, longer):
    run = run_of("marker_pen_2_slip")
    original, repeated = report_of(run).row, report_of(stored(run, tmp_path / run.name, times)).row
    assert original["lost_frame"] is not None
    assert repeated["refused_n"] > 30, "otherwise no frame was a repeated one"
    assert {key: abs(repeated[key] - longer * original[key]) <= 3 for key in PHASES} == dict.fromkeys(PHASES, True)


@pytest.mark.real_data
@pytest.mark.parametrize("size", [(446, 335), (512, 384)])
def test_a_loss_is_found_in_somewhat_larger_pictures_too(tmp_path, size):
    run = run_of("pattern_cotton_cloth_1_slip")
    row = report_of(stored(run, tmp_path / run.name, lambda _: 1, size)).row
    assert abs(row["lost_frame"] - 49) <= 2


@pytest.mark.real_data
def test_pictures_whose_markers_would_become_too_small_are_left_as_they_are(tmp_path):
    picture = cv2.imread(str(real_data("gelslim_raw") / "finger_1_427x320.png"))
    out = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.VideoWriter_fourcc(*"FFV1"), 25, picture.shape[1::-1])
    out.write(picture)
    out.release()
    assert watched(tmp_path / "a.avi").fields[0].pitch_px == pytest.approx(13.0, abs=0.3), "in the raw frame"
