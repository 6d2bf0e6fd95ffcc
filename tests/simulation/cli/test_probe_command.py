"""`python -m simulation probe`: a person looks at one descent."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from service.contract import FINGERS
from simulation.__main__ import main
from simulation.data.probe import run_probe
from simulation.optics.appearance import Appearance
from simulation.optics.renderer import Renderer
from simulation.scene.worlds import load_scene

PROBE = ["probe", "circle", "--x-mm", "8", "--theta-deg", "5", "--seed", "3"]


def test_a_saved_picture_is_the_renderers_last_frame_of_both_fingers(tmp_path: Path, capsys) -> None:
    path = tmp_path / "last.png"
    assert main([*PROBE, "--save", str(path)]) == 0
    picture = cv2.imread(str(path))
    scene = load_scene("circle")
    probe = run_probe(scene, 8.0, 5.0, seed=3)
    now, before = probe.gel[-1].astype(np.float32), probe.gel[-2].astype(np.float32)
    drawn = [
        Renderer(Appearance.draw(scene, finger, 3)).rectified(now[k], 2 * 29 + k, before[k])
        for k, finger in enumerate(FINGERS)
    ]
    np.testing.assert_array_equal(picture, np.concatenate(drawn, axis=1))
    assert "outcome blocked" in capsys.readouterr().out


def test_a_saved_video_shows_every_kept_frame_at_the_cameras_rate(tmp_path: Path) -> None:
    path = tmp_path / "descent.mp4"
    assert main([*PROBE, "--save", str(path)]) == 0
    video = cv2.VideoCapture(str(path))
    frames = []
    while (read := video.read())[0]:
        frames.append(read[1])
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(30.0)
    assert len(frames) == 30
    assert frames[0].shape == (320, 654, 3)
    moved = np.abs(frames[-1].astype(float) - frames[0]).mean()
    assert moved > np.abs(frames[1].astype(float) - frames[0]).mean() + 1.0


@pytest.mark.parametrize("name", ["out.gif", "no/such/folder/out.png", "no/such/folder/out.mp4"])
def test_a_picture_that_cannot_be_written_is_one_line(tmp_path: Path, name: str, capsys) -> None:
    assert main([*PROBE, "--save", str(tmp_path / name)]) == 2
    shown = capsys.readouterr()
    assert (shown.out, shown.err.count("\n")) == ("", 1), "refused before anything is computed"


def test_the_layer_tier_can_be_looked_at(capsys) -> None:
    assert main(["probe", "circle", "--tier", "layer"]) == 0
    assert "outcome blocked" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["explain", "probe"])
def test_an_object_that_cannot_be_held_is_one_line(tmp_path: Path, capsys, command: str) -> None:
    tiny = tmp_path / "tiny.toml"
    shape = '[object]\nshape = "rectangle"\nsize_x_mm = 6.0\nsize_y_mm = 6.0\n'
    tiny.write_text(f"{shape}[grasp]\nforce_n = 120.0\n")
    assert main([command, str(tiny)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "grasp.force_n: 120.0 N squeezes the gel through; it bears" in line


def test_a_deeper_gap_is_descended_to_its_full_depth() -> None:
    scene = load_scene("rectangle", blocks__insertion_depth_mm=21.0)
    probe = run_probe(scene, 0.2, 0.1)
    assert probe.outcome == "inserted"
    assert probe.depth_mm[-1] == pytest.approx(scene.full_depth_mm)
