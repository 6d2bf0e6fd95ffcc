"""Calibration finds the rectification that a simulated camera was drawn with, and refuses what is no resting gel."""

import cv2
import numpy as np
import pytest

from service.__main__ import main
from service.contract import FINGERS, Finger, Sensor
from service.perception.rectification import Calibration, CalibrationError
from service.tools.calibrate import fit_camera
from simulation.optics.appearance import Appearance
from simulation.optics.renderer import Renderer
from simulation.scene.worlds import load_scene

REST = np.zeros((20, 21, 3), np.float32)
INSIDE_PX = np.array([[[60, 40], [360, 40], [213, 160], [150, 280], [280, 280]]], float)


def renderer(finger: Finger, seed: int) -> Renderer:
    return Renderer(Appearance.draw(load_scene("rectangle"), finger, seed))


def still(camera: Renderer) -> np.ndarray:
    return np.median(np.stack([camera.raw(REST, i) for i in range(5)]), axis=0).astype(np.uint8)


@pytest.mark.parametrize("seed", range(3))
def test_the_homography_of_a_simulated_camera_is_found(seed: int):
    camera = renderer(FINGERS[seed % 2], seed)
    fit = fit_camera(still(camera), "left", Sensor.load())
    found = cv2.perspectiveTransform(INSIDE_PX, fit.camera.homography)
    true = cv2.perspectiveTransform(INSIDE_PX, np.asarray(camera.homography))
    assert fit.lattice.detected.shape == (20, 21)
    assert np.abs(found - true).max() < 1.5


@pytest.mark.parametrize("image", [np.zeros((320, 427, 3), np.uint8), np.full((320, 427, 3), 255, np.uint8)])
def test_a_frame_without_markers_is_refused_by_finger(image: np.ndarray):
    with pytest.raises(CalibrationError, match="right: no marker grid"):
        fit_camera(image, "right", Sensor.load())


def test_a_pressed_gel_is_refused():
    pressed = REST.copy()
    pressed[5:15, 5:16, 0] = 0.5
    camera = renderer("left", 0)
    with pytest.raises(CalibrationError, match="touches the gel"):
        fit_camera(camera.raw(pressed, 0), "left", Sensor.load())


def test_the_command_writes_a_file_that_the_service_loads(tmp_path, capsys):
    for finger in FINGERS:
        (tmp_path / finger).mkdir()
        cv2.imwrite(str(tmp_path / finger / "0.png"), still(renderer(finger, 0)))
    out = tmp_path / "calibration.toml"
    cameras = [f"--camera-{finger}=file:{tmp_path / finger}" for finger in ("left", "right")]
    assert main(["calibrate", *cameras, "--out", str(out), "--frames", "2", "--pictures", str(tmp_path)]) == 0
    assert "20 markers" not in capsys.readouterr().err
    assert Calibration.load(out).left.raw.width_px == 427
    assert (tmp_path / "left.png").exists()


def test_an_absent_camera_is_one_line_and_exit_2(tmp_path, capsys):
    camera = f"file:{tmp_path / 'nothing'}"
    assert main(["calibrate", "--camera-left", camera, "--camera-right", camera]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
