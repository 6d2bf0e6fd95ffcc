import cv2
import numpy as np
import pytest

from service.__main__ import main
from tests.service.perception.real import real_data
from tests.service.perception.synthetic import draw, grid


@pytest.fixture
def clip(tmp_path):
    rng = np.random.default_rng(0)
    rest = grid()
    slide = np.zeros_like(rest)
    slide[5:15, 5:15, 1] = 1.2
    folder = tmp_path / "clip"
    folder.mkdir()
    for k in range(30):
        cv2.imwrite(str(folder / f"{k:03}.png"), draw(rest + max(0, k - 18) * slide, rng))
    return folder


def test_a_folder_of_frames_replays_with_times_and_a_picture(clip, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["replay", str(clip), "--fps", "30", "--out", str(out)]) == 0
    (picture,) = out.iterdir()
    events = cv2.imread(str(picture))
    assert events.shape[1] == 1200
    assert events.shape[0] > 500
    said = capsys.readouterr().out
    assert "grid of 20 rows x 21 columns" in said
    assert "hold" in said
    assert "contact" in said


def test_plot_writes_the_video_too(clip, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["replay", str(clip), "--plot", "--out", str(out)]) == 0
    assert {path.suffix for path in out.iterdir()} == {".avi", ".png"}
    assert all(path.stat().st_size > 1000 for path in out.iterdir())


@pytest.mark.parametrize("what", ["missing", "empty", "broken", "crop"])
def test_a_bad_recording_is_one_line_and_exit_code_2(what, clip, tmp_path, capfd):
    arguments = {"missing": [str(tmp_path / "nowhere")], "crop": [str(clip), "--crop", "0", "0", "900", "10"]}
    if what == "empty":
        (tmp_path / "empty").mkdir()
        arguments["empty"] = [str(tmp_path / "empty")]
    if what == "broken":
        (tmp_path / "x.avi").write_bytes(b"no video")
        arguments["broken"] = [str(tmp_path / "x.avi")]
    assert main(["replay", *arguments[what]]) == 2
    said = [line for line in capfd.readouterr().err.splitlines() if line.startswith("service replay")]
    assert len(said) == 1


@pytest.mark.real_data
def test_a_real_clip_replays(tmp_path, capsys):
    folder = real_data("gelsight_mini_slip") / "ball_white_thread_10_slip"
    assert main(["replay", str(folder), "--fps", "8", "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "grid of 5 rows x 7 columns" in said
    assert "hold" in said
