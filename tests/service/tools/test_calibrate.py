"""Calibration finds a simulated camera's rectification, and refuses anything but a resting gel."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from service.__main__ import main
from service.contract import FINGERS, Finger, Sensor, TactileFrame
from service.perception.finger import TactileFinger
from service.perception.lens import Warp
from service.perception.markers.fingerprint import likeness
from service.perception.rectification import Calibration, CalibrationError
from service.tools.calibrate import fit_camera, remarks
from simulation.optics.appearance import Appearance
from simulation.optics.renderer import Renderer
from simulation.scene.worlds import load_scene
from tests.service.mjpeg import answering
from tests.service.perception.real import GELSLIM_CROP, read_video, real_data

REST = np.zeros((20, 21, 3), np.float32)
UNEVEN = np.float32(0.02) * np.random.default_rng(3).normal(size=(20, 21, 3)).astype(np.float32) * [1, 1, 0]
INSIDE_PX = np.array([[[60, 40], [360, 40], [213, 160], [150, 280], [280, 280]]], float)


def renderer(finger: Finger, seed: int) -> Renderer:
    return Renderer(Appearance.draw(load_scene("rectangle"), finger, seed))


def still(camera: Renderer) -> np.ndarray:
    return np.median(np.stack([camera.raw(REST, i) for i in range(5)]), axis=0).astype(np.uint8)


@pytest.mark.parametrize("seed", range(2))
def test_the_homography_of_a_simulated_camera_is_found(seed: int):
    camera = renderer(FINGERS[seed % 2], seed)
    fit = fit_camera(still(camera), "left", Sensor.load())
    plane_px = fit.camera.projection.plane(INSIDE_PX[0])
    true = cv2.perspectiveTransform(INSIDE_PX, np.asarray(camera.homography))
    assert fit.grid.shape == (20, 21)
    assert np.abs(plane_px - true).max() < 1.5


@pytest.mark.parametrize(("size", "grey"), [((320, 427, 3), 0), ((320, 427, 3), 255), ((2, 1, 3), 90)])
def test_a_frame_without_markers_is_refused_by_finger(size: tuple[int, ...], grey: int):
    with pytest.raises(CalibrationError, match="right: no marker grid"):
        fit_camera(np.full(size, grey, np.uint8), "right", Sensor.load())


def test_a_pressed_gel_is_refused():
    pressed = REST.copy()
    pressed[5:15, 5:16, 0] = 0.5
    camera = renderer("left", 0)
    with pytest.raises(CalibrationError, match="touches the gel"):
        fit_camera(camera.raw(pressed, 0), "left", Sensor.load())


def test_markers_that_the_service_would_not_find_are_refused():
    """They are visible in one colour only, in which they are fitted; a session tracks in grey."""
    grey = cv2.cvtColor(still(renderer("left", 0)), cv2.COLOR_BGR2GRAY).astype(float)
    image = np.full((*grey.shape, 3), 120.0)
    image[..., 0] += (grey - grey.mean()) * 20 / np.ptp(grey)
    image += np.random.default_rng(0).normal(0, 2, image.shape)
    with pytest.raises(CalibrationError, match="left: the service finds no grid in the rectified picture"):
        fit_camera(image.astype(np.uint8), "left", Sensor.load())


def test_the_command_writes_a_file_that_the_service_loads(tmp_path, capsys):
    for finger in FINGERS:
        (tmp_path / finger).mkdir()
        cv2.imwrite(str(tmp_path / finger / "0.png"), still(renderer(finger, 0)))
    out = tmp_path / "calibration.toml"
    cameras = [f"--camera-{finger}=file:{tmp_path / finger}" for finger in ("left", "right")]
    out.write_text("the one of before")
    assert main(["calibrate", *cameras, "--out", str(out), "--frames", "2", "--pictures", str(tmp_path)]) == 0
    assert main(["calibrate", *cameras, "--out", str(out), "--up", "bottom"]) == 2, "which only a new profile can state"
    first = out.read_text()
    assert main(["calibrate", *cameras, "--out", str(out), "--frames", "2"]) == 0
    assert {kept.read_text() for kept in tmp_path.glob("calibration.*.toml")} == {"the one of before", first}
    assert "21 x 20 markers" in capsys.readouterr().out
    left = Calibration.load(out).left
    assert left.raw.width_px == 427
    assert left.measured is not None
    assert left.measured.residual_px < 0.5
    assert (tmp_path / "left.png").exists()
    assert (tmp_path / "left_residual.png").exists()


def test_one_camera_for_both_fingers_is_refused(tmp_path, capsys):
    camera = renderer("left", 0)
    one, two = (cv2.imwrite(str(tmp_path / f"{k}.png"), camera.raw(UNEVEN, k)) for k in range(2))
    assert one
    assert two
    (tmp_path / "again").mkdir()
    cv2.imwrite(str(tmp_path / "again" / "0.png"), camera.raw(UNEVEN, 7))
    for right, message in [(tmp_path, "the same camera, file:"), (tmp_path / "again", "the same gel")]:
        arguments = [f"--camera-left=file:{tmp_path}", f"--camera-right=file:{right}", "--frames", "2"]
        assert main(["calibrate", *arguments, "--out", str(tmp_path / "c.toml")]) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "c.toml").exists()


def test_two_gels_that_their_lenses_bend_alike_are_two(tmp_path):
    """Fingerprints of two real fingers with 42 markers each were 0.94 alike."""
    scene = load_scene("circle", camera__sensor="gelsight_mini")
    v, u = np.mgrid[0:240, 0:320].astype(np.float32)
    swung_u, swung_v = u + 0.8 * np.sin(v / 8), v + 0.8 * np.sin(u / 8)
    for finger in FINGERS:
        straight = Renderer(Appearance.draw(scene, finger, 3)).raw(np.zeros((7, 9, 3), np.float32), 0)
        (tmp_path / finger).mkdir()
        cv2.imwrite(str(tmp_path / finger / "0.png"), cv2.remap(straight, swung_u, swung_v, cv2.INTER_LINEAR))
    cameras = [f"--camera-{finger}=file:{tmp_path / finger}" for finger in FINGERS]
    out = tmp_path / "c.toml"
    assert main(["calibrate", *cameras, "--sensor", "gelsight_mini", "--out", str(out), "--frames", "1"]) == 0
    measured = [Calibration.load(out).camera(finger).measured for finger in FINGERS]
    alike = likeness(*(one.fingerprint for one in measured if one is not None))
    assert alike is not None
    assert alike > 0.75, "otherwise this tests nothing"


def test_a_picture_is_measured_into_a_row_of_figures(tmp_path):
    picture, row = tmp_path / "a.png", tmp_path / "a.json"
    cv2.imwrite(str(picture), still(renderer("left", 1)))
    assert main(["calibrate", "--picture", str(picture), "--sensor", "gelslim_2019", "--json", str(row)]) == 0
    figures = json.loads(row.read_text())
    assert (figures["rows"], figures["columns"], figures["refused"]) == (20, 21, None)
    assert figures["residual_px"] < 0.5
    assert figures["found_share"] > 0.95


def test_without_a_file_the_row_is_all_that_stands_on_stdout(tmp_path, capsys):
    picture, profile = tmp_path / "a.png", tmp_path / "mine.toml"
    cv2.imwrite(str(picture), still(renderer("left", 1)))
    assert main(["calibrate", "--picture", str(picture), "--sensor", "gelslim_2019", "--json"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["refused"] is None
    assert "21 x 20 markers" in printed.err
    assert main(["calibrate", "--json", "--picture", str(picture), "--new-profile", str(profile)]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["sensor"] == "mine"
    assert f"wrote {profile}" in printed.err
    cv2.imwrite(str(picture), np.full((240, 320, 3), 120, np.uint8))
    assert main(["calibrate", "--picture", str(picture), "--json"]) == 2
    printed = capsys.readouterr()
    assert "no marker grid" in json.loads(printed.out)["refused"]
    assert "no marker grid" in printed.err


def test_figures_are_asked_for_of_a_picture_only(tmp_path, capsys):
    cameras = [f"--camera-{finger}=file:{tmp_path}" for finger in FINGERS]
    assert main(["calibrate", *cameras, "--json"]) == 2
    assert "--json takes the figures of one picture: expected with --picture FILE" in capsys.readouterr().err


def test_a_picture_without_markers_is_named_as_such(tmp_path, capsys):
    picture, row = tmp_path / "a.png", tmp_path / "a.json"
    cv2.imwrite(str(picture), np.full((240, 320, 3), 120, np.uint8))
    assert main(["calibrate", "--picture", str(picture), "--json", str(row)]) == 2
    assert "no marker grid in the frame, and this software needs one" in capsys.readouterr().err
    assert json.loads(row.read_text())["found_share"] == 0


def test_a_picture_that_cannot_be_read_leaves_no_row_of_an_earlier_one(tmp_path, capsys):
    picture, row = tmp_path / "a.png", tmp_path / "a.json"
    cv2.imwrite(str(picture), still(renderer("left", 1)))
    assert main(["calibrate", "--picture", str(picture), "--json", str(row)]) == 0
    picture.write_bytes(picture.read_bytes()[:20_000])
    odd = {picture: "a damaged one", tmp_path / "b.png": "No such file", tmp_path: "s a directory"}
    for unreadable, why in odd.items():
        assert main(["calibrate", "--picture", str(unreadable), "--json", str(row)]) == 2
        assert why in capsys.readouterr().err
        figures = json.loads(row.read_text())
        assert (figures["picture"], figures["residual_px"]) == (unreadable.name, None)
        assert why in figures["refused"]


def test_a_picture_larger_than_any_frame_is_refused_in_words_and_leaves_no_row_of_an_earlier_one(tmp_path, capsys):
    picture, row = tmp_path / "a.jpg", tmp_path / "a.json"
    row.write_text('{"residual_px": 0.1}')
    cv2.imwrite(str(picture), cv2.resize(still(renderer("left", 1)), (5472, 4104)))
    assert main(["calibrate", "--picture", str(picture), "--json", str(row)]) == 2
    assert "the frame is 5472 x 4104 px, expected 4096 px a side or less" in capsys.readouterr().err
    assert json.loads(row.read_text())["residual_px"] is None


def test_markers_at_another_distance_are_another_gel(tmp_path):
    """As many markers as the profile allows, but further apart: its millimetres would be wrong."""
    picture, row = tmp_path / "a.png", tmp_path / "a.json"
    scene = load_scene("circle", camera__sensor="gelsight_mini")
    whole = Renderer(Appearance.draw(scene, "left", 3)).raw(np.zeros((7, 9, 3), np.float32), 0)
    height, width = whole.shape[:2]
    nearer = cv2.resize(whole[height // 10 : -height // 10, width // 10 : -width // 10], (width, height))
    cv2.imwrite(str(picture), nearer)
    assert main(["calibrate", "--picture", str(picture), "--sensor", "gelsight_mini", "--json", str(row)]) == 0
    assert "is it another gel or lens" in json.loads(row.read_text())["refused"]


def test_a_picture_that_no_profile_describes_still_gets_a_row(tmp_path, capsys):
    picture, row = tmp_path / "grün\udcff.png", tmp_path / "a.json"
    picture.write_bytes(cv2.imencode(".png", np.full((240, 320, 3), 120, np.uint8))[1].tobytes())
    arguments = ["calibrate", "--picture", str(picture), "--json", str(row)]
    assert main([*arguments, "--new-profile", str(tmp_path / "mine.toml")]) == 2
    assert "no marker grid" in capsys.readouterr().err
    assert (json.loads(row.read_text())["sensor"], (tmp_path / "mine.toml").exists()) == ("mine", False)


def test_rows_that_are_bent_beyond_the_lens_are_remarked_on():
    """A gel glued unevenly is so, and one that something presses."""
    camera = renderer("left", 0)
    flat = fit_camera(still(camera), "left", Sensor.load())
    assert remarks(flat, Sensor.load()) == []
    bulge = Warp(np.zeros(2), np.full(2, 300.0), np.array([[0.0, 0.0, 0.0, 0.3, 0.0, 0.0]] * 2) * flat.pitch_px)
    assert "something presses it" in str(remarks(flat._replace(camera=replace(flat.camera, warp=bulge)), Sensor.load()))


@pytest.mark.parametrize(
    ("shape", "named"),
    [
        ({"marker_rows": 19}, "20 rows in view, 19 kept"),
        ({"marker_columns": 20}, "21 columns in view, 20 kept"),
        (
            {"marker_rows": 21},
            "20 of 21 rows in view: at which edge others are missing cannot be told, so the frame may be half a",
        ),
        (
            {"marker_columns": 23},
            "21 of 23 columns in view: at which edge others are missing cannot be told, so the frame may be a p",
        ),
    ],
)
def test_a_frame_whose_place_is_uncertain_is_remarked_on(shape, named):
    sensor = Sensor.load()
    other = sensor.model_copy(update=shape)
    [line] = remarks(fit_camera(still(renderer("left", 0)), "left", other), other)
    assert line.startswith(named)


@pytest.mark.real_data
@pytest.mark.parametrize("name", ["raw", "gelslim3", "mini"])
def test_real_resting_gels_lie_within_half_a_pixel_of_a_regular_grid(name, tmp_path):
    if name == "raw":
        picture = real_data("gelslim_raw") / "finger_1_427x320.png"
    else:
        picture = tmp_path / "open.png"
        clip, k, crop = {
            "gelslim3": (real_data("gelslim3_press") / "sample_realtime_depth.mp4", 312, GELSLIM_CROP),
            "mini": (real_data("gelsight_mini_slip") / "blue_mug_1_hold" / "camera_2.avi", 9, None),
        }[name]
        cv2.imwrite(str(picture), read_video(clip, crop)[k])
    sensor = {"raw": "gelslim_2019", "gelslim3": "gelslim_2019", "mini": "gelsight_mini"}[name]
    row = tmp_path / "row.json"
    assert main(["calibrate", "--picture", str(picture), "--sensor", sensor, "--json", str(row)]) == 0
    figures = json.loads(row.read_text())
    assert figures["residual_px"] <= 0.5
    assert figures["found_share"] > 0.9
    other = {"raw": None, "gelslim3": "16 x 11 markers found", "mini": "44.6 px apart, the profile"}[name]
    assert figures["refused"] is other or other in figures["refused"], "other gels are measured, not accepted"


def test_an_absent_camera_is_one_line_and_exit_2(tmp_path, capsys):
    camera = f"file:{tmp_path / 'nothing'}"
    assert main(["calibrate", "--camera-left", camera, "--camera-right", camera]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_finger_learns_the_gel_that_it_was_calibrated_with_and_no_other(seed: int):
    """Swapped cameras each look correct; the print distinguishes them."""
    cameras = {finger: renderer(finger, seed) for finger in FINGERS}
    own = {finger: fit_camera(still(cameras[finger]), finger, Sensor.load()).camera for finger in FINGERS}
    for finger, other in (FINGERS, FINGERS[::-1]):
        watch = TactileFinger(finger, Sensor.load().rectified, own[finger], beside=own[other])
        for shown in FINGERS:
            frame = TactileFrame(finger, 1, 1, cameras[shown].raw(REST, 7))
            why = watch.learn_open(frame)
            assert bool(why) == (shown != finger), why
            assert ("swapped" in watch.explain(frame)) == (shown != finger)
            assert watch.gel_distance is not None
            assert 0.0 <= watch.gel_distance <= 2.0
            assert (watch.gel_distance < 0.2) == (shown == finger)


@pytest.mark.parametrize("answer", [b"SSH-2.0-OpenSSH_9\r\n", b"HTTP/1.1 404 Not Found\r\n\r\n", b""])
def test_what_is_no_camera_is_one_line_that_names_it_and_exit_2(answer: bytes, capsys: pytest.CaptureFixture[str]):
    with answering(answer) as url:
        assert main(["calibrate", "--camera-left", url, "--camera-right", "v4l2:99"]) == 2
    assert f"camera {url}: " in capsys.readouterr().err
