"""The profile of a new sensor: counted and measured in one picture, and a good one for that picture."""

import cv2
import numpy as np
import pytest

from service.__main__ import main
from service.contract import Sensor
from service.perception.markers.tracker import MarkerTracker
from service.perception.rectification import Rectifier
from service.tools.calibrate import find_grid, fit_camera
from service.tools.calibration_output import profile_of
from simulation.optics.appearance import Appearance
from simulation.optics.renderer import Renderer
from simulation.scene.worlds import load_scene
from tests.service.tools.test_calibrate import renderer, still
from tests.service.tools.test_grid_fit import printed


def test_a_new_profile_has_the_counts_that_are_seen(tmp_path):
    picture, profile = tmp_path / "a.png", tmp_path / "mine.toml"
    scene = load_scene("circle", camera__sensor="gelsight_mini")
    mini = Renderer(Appearance.draw(scene, "left", 3))
    cv2.imwrite(str(picture), mini.raw(np.zeros((7, 9, 3), np.float32), 0))
    assert main(["calibrate", "--picture", str(picture), "--new-profile", str(profile), "--pitch-mm", "2"]) == 0
    sensor = Sensor.load(profile)
    assert (sensor.marker_rows, sensor.marker_columns) == (7, 9)
    assert sensor.marker_pitch_mm == pytest.approx(2, rel=1e-3)
    assert fit_camera(cv2.imread(str(picture)), "left", sensor).residual_px < 0.5


@pytest.mark.parametrize(("pitch_mm", "served"), [(1.05, True), (1.3, False), (0.5, False)])
def test_a_new_profile_has_the_frame_of_the_released_networks_where_gel_and_picture_fill_it(pitch_mm: float, served):
    """The same picture of a larger gel would have no room there; of a smaller one, it ends before that frame does."""
    image = still(renderer("left", 1))
    released = Sensor.load()
    sensor = profile_of(image, find_grid(image, "left", None), "mine", pitch_mm, 30, released)
    assert ((sensor.rectified, sensor.mm_per_px) == (released.rectified, released.mm_per_px)) is served
    assert sensor.marker_pitch_mm == pytest.approx(pitch_mm, rel=1e-3)
    fit = fit_camera(image, "left", sensor)
    assert fit.residual_px < 0.5
    assert fit.camera.mm_per_px == sensor.mm_per_px


@pytest.mark.parametrize(("around", "served"), [(90.0, True), (2.0, False)])
def test_a_new_profile_ends_where_the_edge_of_the_gel_would_pass_for_markers(around: float, served: bool):
    whole = printed(np.stack(np.meshgrid(np.arange(12), np.arange(9)), -1).reshape(-1, 2).astype(float), 0.7)
    frame = np.asarray(cv2.copyMakeBorder(whole, 120, 200, 120, 200, cv2.BORDER_REPLICATE), np.float64)
    gel = np.zeros(frame.shape[:2])
    gel[150 - 24 : 150 + 9 * 24, 150 - 24 : 150 + 12 * 24] = 1
    gel = cv2.GaussianBlur(gel, (0, 0), 2)[..., None]
    image = (gel * frame + (1 - gel) * around).astype(np.uint8)
    grid = find_grid(image, "left", None)
    assert grid.shape == (9, 12)
    sensor = profile_of(image, grid, "mine", 1.5, 30, Sensor.load())
    assert (sensor.rectified == Sensor.load().rectified) is served
    shown = MarkerTracker().update(Rectifier(fit_camera(image, "left", sensor).camera).apply(image), 0)
    assert shown.valid.shape == grid.shape


def test_a_new_profile_ends_where_the_picture_of_a_larger_gel_ends():
    """What the frame had beyond the picture would be black, and the tracker would take its edge for more markers."""
    whole = still(renderer("left", 1))
    image = whole[60:250, 110:320]
    grid = find_grid(image, "left", None)
    sensor = profile_of(image, grid, "mine", 1.05, 30, Sensor.load())
    fit = fit_camera(image, "left", sensor)
    shown = MarkerTracker().update(Rectifier(fit.camera).apply(image), 0)
    assert (sensor.marker_rows, sensor.marker_columns) == grid.shape
    assert shown.valid.shape == grid.shape


def test_a_new_profile_fits_the_picture_that_it_was_made_from_through_a_wide_lens():
    """Beyond the outer markers such a lens squeezes the picture, and four corners cannot state that."""
    mini = Renderer(Appearance.draw(load_scene("circle", camera__sensor="gelsight_mini"), "left", 3))
    off = np.stack(np.meshgrid(np.arange(320), np.arange(240)), -1).astype(np.float32) - (159.5, 119.5)
    source = (159.5, 119.5) + off * (1 + 0.9 * np.square(off / 200).sum(-1, keepdims=True)) / 1.2
    flat = mini.raw(np.zeros((7, 9, 3), np.float32), 0)
    image = cv2.remap(flat, source.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    sensor = profile_of(image, find_grid(image, "left", None), "mine", 2.0, 30)
    assert fit_camera(image, "left", sensor).residual_px < 0.5


@pytest.mark.parametrize(
    ("up", "turn"),
    [("right", cv2.ROTATE_90_CLOCKWISE), ("bottom", cv2.ROTATE_180), ("left", cv2.ROTATE_90_COUNTERCLOCKWISE)],
)
def test_a_camera_mounted_turned_shows_the_gel_upright_once_calibrated(up: str, turn: int, tmp_path):
    upright, picture, profile = still(renderer("left", 1)), tmp_path / "a.png", tmp_path / "mine.toml"
    turned = np.asarray(cv2.rotate(upright, turn), np.uint8)
    cv2.imwrite(str(picture), turned)
    arguments = ["--picture", str(picture), "--new-profile", str(profile), "--pitch-mm", "1.05", "--up", up]
    assert main(["calibrate", *arguments]) == 0
    sensor = Sensor.load(profile)
    assert (sensor.up, sensor.rectified) == (up, Sensor.load().rectified)
    one, other = (
        Rectifier(fit_camera(image, "left", its).camera).apply(image).astype(int)
        for image, its in ((upright, Sensor.load()), (turned, sensor))
    )
    assert np.abs(one - other).mean() < 1
    assert np.abs(one - other[::-1, ::-1]).mean() > 5, "otherwise this tests nothing"


def test_a_profile_that_somebody_has_edited_is_kept_beside_the_new_one(tmp_path, capsys):
    picture, profile = tmp_path / "a.png", tmp_path / "mine.toml"
    cv2.imwrite(str(picture), still(renderer("left", 1)))
    profile.write_text("mm_per_px = 0.0712  # measured")
    assert main(["calibrate", "--picture", str(picture), "--new-profile", str(profile)]) == 0
    (kept,) = tmp_path.glob("mine.*.toml")
    assert kept.read_text() == "mm_per_px = 0.0712  # measured"
    assert str(kept) in capsys.readouterr().out
    assert Sensor.load(profile).name == "mine"


def test_a_new_profile_that_no_sensor_option_could_name_is_refused(tmp_path, capsys):
    picture = tmp_path / "a.png"
    cv2.imwrite(str(picture), still(renderer("left", 1)))
    assert main(["calibrate", "--picture", str(picture), "--new-profile", str(tmp_path / "mine")]) == 2
    assert "expected a file name that ends in .toml" in capsys.readouterr().err
