import math
import re
from contextlib import nullcontext
from dataclasses import replace

import cv2
import numpy as np
import pytest

from service.contract import FrameSpec, Sensor
from service.perception.lens import Lens, Projection, Warp
from service.perception.light import light_of
from service.perception.rectification import Calibration, CalibrationError, CameraCalibration, Measured, Rectifier
from tests.service.perception.synthetic import draw, grid

SENSOR = Sensor.load()

FINGERPRINT = "AQEAAA=="  # of a single marker in its place
LIGHT = light_of(np.full((8, 8, 3), 4, np.uint8))
TRAPEZOID = cv2.getPerspectiveTransform(
    np.array([(20, 10), (407, 10), (320, 310), (107, 310)], np.float32),
    np.array([(0, 0), (326, 0), (326, 319), (0, 319)], np.float32),
).astype(np.float64)


def test_a_saved_calibration_loads_back_exactly(tmp_path):
    camera = CameraCalibration(TRAPEZOID, SENSOR.raw, SENSOR.rectified, mm_per_px=0.07)
    Calibration(camera, camera).save(tmp_path / "c.toml")
    loaded = Calibration.load(tmp_path / "c.toml")
    assert np.array_equal(loaded.left.homography, TRAPEZOID)
    assert (loaded.camera("right").raw, loaded.camera("right").mm_per_px) == (camera.raw, 0.07)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("[left]", "[middle]"), "middle is not used; allowed: left, right"),
        (lambda text: text.replace("schema_version = 1", "schema_version = 9"), "schema_version"),
        (lambda text: text.replace("raw_px = [427, 320]", "raw_px = [427]", 1), "left"),
        (lambda text: text.replace("raw_px = [427, 320]", "", 1), "raw_px: missing"),
        (lambda text: text.replace(repr(float(TRAPEZOID[0, 0])), "nan"), "finite"),
        (lambda _: "a = [", "not valid TOML"),
        (lambda text: text.replace("[327, 320]", "[320, 320]", 1), "left and right to 320 x 320 and 327 x 320"),
        (lambda text: text.replace(FINGERPRINT, FINGERPRINT[:-1]), r"\[right\]: no fingerprint of a gel: 'AQEAAA='"),
        (lambda text: text.replace(LIGHT, LIGHT[:-4]), r"\[right\]: no light of a gel: 'BAQEBAQEBAQEBAQEBAQE'"),
    ],
)
def test_a_broken_file_is_refused_by_name(tmp_path, change, message):
    path = tmp_path / "c.toml"
    measured = Measured("2026-01-01", "", 0.3, 1.0, FINGERPRINT, LIGHT)
    Calibration(
        CameraCalibration(TRAPEZOID, SENSOR.raw, SENSOR.rectified),
        CameraCalibration(TRAPEZOID, SENSOR.raw, SENSOR.rectified, measured=measured),
    ).save(path)
    path.write_text(change(path.read_text()))
    with pytest.raises(CalibrationError, match=message) as caught:
        Calibration.load(path)
    assert str(path) in str(caught.value)


def test_rectified_markers_lie_where_the_homography_puts_them():
    rng = np.random.default_rng(0)
    flat = draw(grid(), rng, noise=0)
    raw = cv2.warpPerspective(flat, np.linalg.inv(TRAPEZOID), (427, 320), flags=cv2.INTER_LINEAR)
    again = Rectifier(CameraCalibration(TRAPEZOID, SENSOR.raw, SENSOR.rectified)).apply(np.asarray(raw, np.uint8))
    inner = np.s_[5:-5, 5:-5]
    assert np.abs(again[inner].astype(int) - flat[inner]).mean() < 8


BENT = CameraCalibration(
    TRAPEZOID,
    SENSOR.raw,
    SENSOR.rectified,
    Lens((210.0, 155.0), 266.8, 0.08, -0.01),
    Warp(np.array([10.0, 20.0]), np.array([310.0, 300.0]), np.array([[1.0, 0.5, -2.0], [0.2, 1.5, 0.3]])),
    Measured("2026-01-01", "A1", 0.31, 0.97, FINGERPRINT, LIGHT),
    0.07,
)


def test_a_file_of_before_lights_were_stored_is_loaded(tmp_path):
    Calibration(BENT, BENT).save(tmp_path / "c.toml")
    lines = (tmp_path / "c.toml").read_text().splitlines()
    (tmp_path / "c.toml").write_text("\n".join(line for line in lines if not line.startswith("light")))
    measured = Calibration.load(tmp_path / "c.toml").left.measured
    assert measured is not None
    assert (measured.fingerprint, measured.light) == (FINGERPRINT, "")


def test_lens_warp_and_what_was_measured_are_loaded_back(tmp_path):
    Calibration(BENT, CameraCalibration(TRAPEZOID, SENSOR.raw, SENSOR.rectified)).save(tmp_path / "c.toml")
    loaded = Calibration.load(tmp_path / "c.toml")
    assert (loaded.left.lens, loaded.left.measured, loaded.left.mm_per_px) == (BENT.lens, BENT.measured, 0.07)
    assert (loaded.right.lens, loaded.right.warp, loaded.right.measured) == (None, None, None)
    places = np.random.default_rng(0).uniform(0, 300, (20, 2))
    assert np.array_equal(loaded.left.projection.plane(places), BENT.projection.plane(places))


@pytest.mark.parametrize("key", ["lens_scale_px", "lens_k", "warp_low_px", "date", "found_share"])
def test_a_part_of_a_lens_a_warp_or_a_measurement_is_refused_and_not_left_out(tmp_path, key):
    """A file edited by hand: without its lens, the frames would be rectified wrongly, and nothing would say so."""
    Calibration(BENT, BENT).save(tmp_path / "c.toml")
    lines = (tmp_path / "c.toml").read_text().splitlines()
    (tmp_path / "c.toml").write_text("\n".join(line for line in lines if not line.startswith(f"{key} =")))
    with pytest.raises(CalibrationError, match=rf"\[left\]: {key}: missing; expected"):
        Calibration.load(tmp_path / "c.toml")


def test_each_rectified_pixel_shows_the_raw_one_from_which_it_is_projected():
    """The raw frame holds its own coordinates, halved; what lies outside it is black."""
    v, u = np.mgrid[0:320, 0:427]
    raw = np.stack([u / 2, v / 2, np.full_like(u, 255)], -1).astype(np.uint8)
    shown = Rectifier(BENT).apply(raw)
    places = np.array([[5, 7], [160, 150], [300, 40], [40, 310], [320, 300]])
    source = BENT.projection.raw(places.astype(np.float64))
    assert shown[places[:, 1], places[:, 0], :2] == pytest.approx(source / 2, abs=1.0)
    aside = CameraCalibration(np.array([[1.0, 0, 150], [0, 1, 0], [0, 0, 1]]), SENSOR.raw, SENSOR.rectified)
    shown = Rectifier(aside).apply(raw)
    assert not shown[:, :149].any()
    assert (shown[:, 151:, 2] == 255).all()


def test_a_bent_camera_is_tabulated_once_however_often_its_pictures_are_asked_for(monkeypatch):
    """It takes a third of a second, in which no message would be answered."""
    camera = replace(BENT)
    first = Rectifier(camera)
    monkeypatch.setattr(Projection, "raw", None)
    raw = np.full(camera.raw.shape, 7, np.uint8)
    assert np.array_equal(Rectifier(camera).apply(raw), first.apply(raw))


def homography(*, from_rectified):
    return np.linalg.inv(np.array(from_rectified, np.float64))


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(3) * np.nan, "3 x 3 finite numbers"),
        (np.eye(2), "3 x 3 finite numbers"),
        (np.zeros((3, 3)), "degenerate"),
        (np.array([[1.0, 2, 0], [2, 4, 0], [0, 0, 1]]), "degenerate"),
        (homography(from_rectified=[[1, 0, 0], [0, 1, 0], [-1 / 200, 0, 1]]), "horizon"),
        (homography(from_rectified=[[1, 0, 0], [0, 1, 0], [0, -1 / 319, 1]]), "horizon"),
        (homography(from_rectified=[[1, 0, 0], [0, 1, 0], [-1 / 327, 0, 1 + 1e-12]]), "horizon"),
        (np.array([[1.0, 0, 430], [0, 1, 0], [0, 0, 1]]), "outside the raw one"),
        (np.array([[12.0, 0, 0], [0, 12, 0], [0, 0, 1]]), "outside the raw one"),
    ],
)
def test_a_homography_that_shows_no_gel_is_refused(matrix, message):
    with pytest.raises(CalibrationError, match=message):
        CameraCalibration(matrix, SENSOR.raw, SENSOR.rectified)


@pytest.mark.parametrize(
    "matrix",
    [-TRAPEZOID, 1e-3 * TRAPEZOID, homography(from_rectified=[[1, 0, 0], [0, 1, 0], [-1 / 400, 0, 1]])],
)
def test_a_homography_is_the_same_whatever_its_factor_and_may_lean(matrix):
    CameraCalibration(matrix, SENSOR.raw, SENSOR.rectified)


@pytest.mark.parametrize(("share", "enough"), [(0.015, False), (0.025, True)])
def test_a_gel_that_fills_less_than_a_fiftieth_of_the_raw_frame_is_refused(share, enough):
    raw_px2, shown_px2 = (
        SENSOR.raw.width_px * SENSOR.raw.height_px,
        SENSOR.rectified.width_px * SENSOR.rectified.height_px,
    )
    scale = math.sqrt(shown_px2 / (share * raw_px2))
    with nullcontext() if enough else pytest.raises(CalibrationError, match="outside the raw one"):
        CameraCalibration(np.diag([scale, scale, 1.0]), SENSOR.raw, SENSOR.rectified)


FOLDED = Warp(BENT.warp.low, BENT.warp.high, np.array([[0.0, 0.0, 100.0], [0.0, 0.0, 0.0]]))


@pytest.mark.parametrize(
    ("change", "message"),
    [({"lens": Lens((213.0, 160.0), 266.8, -0.4, 0.0)}, "lens_k"), ({"warp": FOLDED}, "warp_px")],
)
def test_a_lens_or_warp_that_folds_the_frame_is_refused(change, message):
    with pytest.raises(CalibrationError, match=f"{message} folds"):
        CameraCalibration(TRAPEZOID, SENSOR.raw, SENSOR.rectified, **change)


@pytest.mark.parametrize(
    ("width_px", "height_px", "mm_per_px", "says"),
    [
        (None, None, None, ""),
        (None, None, 1.0, ""),
        (None, None, 1.002, "mm per px, the models expect"),
        (326, None, None, r"\(326, "),
        (None, 318, None, ", 318\\)"),
    ],
)
def test_frames_unlike_those_of_the_models_are_named(models, width_px, height_px, mm_per_px, says):
    card = models.card
    width, height = card.frame.width_px, card.frame.height_px
    frame = FrameSpec(width_px=width_px or width, height_px=height_px or height, rectified=True)
    scale = None if mm_per_px is None else mm_per_px * card.profile.mm_per_px
    one = CameraCalibration(TRAPEZOID, SENSOR.raw, frame, mm_per_px=scale)
    assert re.search(says, Calibration(one, one).unlike(card)) if says else not Calibration(one, one).unlike(card)
