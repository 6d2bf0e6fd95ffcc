"""What is odd about recorded grasps is named, and the others are judged."""

import shutil

import pytest

from service.cameras.recorded import clip_images
from tests.service.tools.test_judge import record, rows_of, write


def test_a_folder_without_videos_beside_the_runs_is_named_and_left_out(tmp_path, capsys):
    record(tmp_path / "runs" / "good", (5, 8), 8)
    (tmp_path / "runs" / "empty").mkdir()
    (tmp_path / "runs" / "dangling").mkdir()
    (tmp_path / "runs" / "dangling" / "camera_0.avi").symlink_to(tmp_path / "gone.avi")
    (tmp_path / "runs" / ".hidden").mkdir()
    rows, _ = rows_of(tmp_path / "runs", tmp_path / "rows.json")
    assert set(rows) == {"good"}
    named = [line for line in capsys.readouterr().err.splitlines() if "no video of a finger" in line]
    assert [line.split(":")[0] for line in named] == [str(tmp_path / "runs" / name) for name in ("dangling", "empty")]


def test_a_folder_without_videos_is_named_one_level_down_too_and_one_that_holds_runs_is_none(tmp_path, capsys):
    record(tmp_path / "runs" / "monday" / "good", (5, 8), 8)
    (tmp_path / "runs" / "monday" / "empty").mkdir()
    rows, returned = rows_of(tmp_path / "runs", tmp_path / "rows.json")
    assert (set(rows), returned) == ({"good"}, 0)
    (named,) = [line for line in capsys.readouterr().err.splitlines() if "no video of a finger" in line]
    assert named.startswith(str(tmp_path / "runs" / "monday" / "empty"))


def test_nothing_else_is_expected_in_a_single_run(tmp_path, capsys):
    record(tmp_path / "box", (5, 8), 8)
    (tmp_path / "box" / "masks").mkdir()
    rows, _ = rows_of(tmp_path / "box", tmp_path / "rows.json")
    assert (set(rows), "no video" in capsys.readouterr().err) == ({"box"}, False)


@pytest.mark.parametrize("how", ["linked", "copied", "cut"])
def test_one_video_under_both_fingers_names_is_no_run(tmp_path, capsys, how):
    record(tmp_path / "runs" / "box", (5, 8), 8)
    left, right = (tmp_path / "runs" / "box" / f"camera_{name}.avi" for name in (0, 2))
    right.unlink()
    right.symlink_to(left) if how == "linked" else shutil.copy(left, right)
    if how == "cut":
        frames = [image for image, _ in clip_images(left)]
        write(left, frames)
        write(right, frames[:-1])
    rows, returned = rows_of(tmp_path / "runs", tmp_path / "rows.json")
    assert (rows, returned) == ({}, 1)
    assert "box: camera_0 and camera_2 have the same pictures" in capsys.readouterr().err


def test_the_rest_of_a_longer_video_is_named(tmp_path, capsys):
    record(tmp_path / "runs" / "box", (5, 8), 8)
    record(tmp_path / "longer", (5, 8), 20)
    shutil.copy(tmp_path / "longer" / "camera_2.avi", tmp_path / "runs" / "box" / "camera_2.avi")
    rows, _ = rows_of(tmp_path / "runs", tmp_path / "rows.json")
    assert rows["box"]["frames_n"] == 8
    assert "box: one video is longer by 12 frames, which are left out" in capsys.readouterr().err
