import cv2
import numpy as np
import pytest

from service.contract import Sensor
from service.perception.rectification import Calibration, CalibrationError, CameraCalibration, Measured, Rectifier
from tests.service.perception.synthetic import draw, grid

SENSOR = Sensor.load()

FINGERPRINT = "AQEAAA=="  # of a single marker in its place
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
    ],
)
def test_a_broken_file_is_refused_by_name(tmp_path, change, message):
    path = tmp_path / "c.toml"
    measured = Measured("2026-01-01", "", 0.3, 1.0, FINGERPRINT)
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
