"""A gel of few markers is known by its light: its own is never refused for its print, another is refused by name."""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.contract import FINGERS, Finger, Sensor, TactileFrame
from service.decision.models import ModelSet
from service.perception.finger import TactileFinger
from service.perception.identity import Compared, compared, doubt, shows, untold
from service.perception.light import OTHER_LIGHT, light_apart, light_of
from service.perception.markers.fingerprint import OTHER_GEL, SAME_GEL, TELLING_N, fingerprint, markers_n
from service.perception.markers.tracker import MarkerTracker
from service.perception.rectification import Calibration, CameraCalibration, Rectifier
from service.session.factory import make_session
from service.tools.calibrate import find_grid, fit_camera, rectify
from service.tools.calibration_output import profile_of
from simulation.optics.appearance import Appearance
from simulation.optics.renderer import Renderer
from simulation.scene.worlds import load_scene
from tests.service.perception.real import read_video, real_data

MINI = Sensor.load("gelsight_mini")
SCENE = load_scene("circle", camera__sensor="gelsight_mini", camera__noise_grey=2.7)
REST = np.zeros((MINI.marker_rows, MINI.marker_columns, 3), np.float32)
SWAPPED = "it is the other finger's: the cameras are swapped, or one serves both fingers"
LIKENESS = st.none() | st.floats(-1, 1)
APART = st.none() | st.floats(0, 3)


@given(LIKENESS, APART, st.integers(TELLING_N, 500))
def test_many_markers_tell_a_gel_by_their_print_alone(alike: float | None, apart: float | None, markers_n: int):
    expected = None if alike is None else alike >= OTHER_GEL
    assert Compared(alike, apart, markers_n).same is expected


@given(LIKENESS, st.floats(0, 3), st.integers(0, TELLING_N - 1))
def test_few_markers_are_another_gel_where_neither_light_nor_print_is_the_own(alike, apart, markers_n):
    own = apart < OTHER_LIGHT or (alike is not None and alike >= SAME_GEL)
    assert Compared(alike, apart, markers_n).same is own


@given(LIKENESS, st.integers(0, TELLING_N - 1))
def test_few_markers_without_a_light_tell_nothing(alike: float | None, markers_n: int):
    assert Compared(alike, None, markers_n).same is None


def test_limits_belong_to_the_gel_that_they_name():
    assert Compared(OTHER_GEL, None, TELLING_N).same is True
    assert Compared(SAME_GEL, OTHER_LIGHT, TELLING_N - 1).same is True
    assert Compared(None, OTHER_LIGHT, TELLING_N - 1).same is False


@pytest.mark.parametrize(
    ("alike", "apart", "markers_n", "same"),
    [
        (0.49, 0.0, 150, False),
        (0.51, 1.0, 150, True),
        (0.49, 0.0, 149, True),
        (0.94, 0.031, 149, False),
        (0.94, 0.029, 149, True),
        (0.96, 0.031, 149, True),
    ],
)
def test_a_gel_is_refused_where_no_own_one_was_and_every_other_one(alike, apart, markers_n, *, same: bool):
    """With 150 markers below half alike; with fewer 0.95 are asked of a print, or a light at most 3 % apart (0224)."""
    assert Compared(alike, apart, markers_n).same is same


def camera_of(finger: Finger, seed: int, light_shift: float) -> Renderer:
    return Renderer(replace(Appearance.draw(SCENE, finger, seed), light_shift=light_shift))


CAMERAS = {"left": camera_of("left", 0, -0.1), "right": camera_of("right", 0, 0.1), "third": camera_of("left", 4, 0.5)}
CALIBRATED = {finger: fit_camera(CAMERAS[finger].raw(REST, 0), finger, MINI).camera for finger in FINGERS}


def learnt(finger: Finger, shown: str, own: CameraCalibration | None = None, seq: int = 7) -> tuple[str, float | None]:
    """What a finger says of an open gel, and how far that is from its own."""
    other = CALIBRATED["right" if finger == "left" else "left"]
    watch = TactileFinger(finger, MINI.rectified, own or CALIBRATED[finger], beside=other)
    return refusal(watch, TactileFrame(finger, 1, 1, CAMERAS[shown].raw(REST, seq))), watch.gel_distance


def refusal(watch: TactileFinger, frame: TactileFrame) -> str:
    """Why the frame is not the open gel, with the cause; or ""."""
    why = watch.learn_open(frame)
    return f"{why}: {watch.explain(frame)}" if why else ""


@pytest.mark.parametrize("finger", FINGERS)
def test_a_gel_of_few_markers_is_known_again(finger: Finger):
    for seq in (7, 8, 9):
        assert learnt(finger, finger, seq=seq)[0] == ""


@pytest.mark.parametrize("finger", FINGERS)
def test_swapped_cameras_of_few_markers_are_named(finger: Finger):
    why, _ = learnt(finger, "right" if finger == "left" else "left")
    assert why.startswith("this is not the gel that the camera was calibrated with (light ")
    assert why.endswith("% apart, allowed 3%): " + SWAPPED)


@pytest.mark.parametrize("finger", FINGERS)
def test_another_gel_of_few_markers_is_named(finger: Finger):
    why, away = learnt(finger, "third")
    assert "is it another gel, or does something touch or light it?" in why
    assert "swapped" not in why
    assert away is not None
    assert away > 0.3, "the drift charts follow the print, not the light"


def test_without_the_other_fingers_calibration_no_swap_is_named():
    watch = TactileFinger("left", MINI.rectified, CALIBRATED["left"])
    why = refusal(watch, TactileFrame("left", 1, 1, CAMERAS["right"].raw(REST, 7)))
    assert why.endswith(": has the camera moved, is it another gel, or does something touch or light it?")


def test_a_session_knows_swapped_cameras():
    card = SimpleNamespace(frame=MINI.rectified)
    session = make_session(cast("ModelSet", SimpleNamespace(card=card)), Calibration(*CALIBRATED.values()))
    for finger, shown in zip(FINGERS, FINGERS[::-1], strict=True):
        watch = session.left if finger == "left" else session.right
        why = refusal(watch, TactileFrame(finger, 1, 1, CAMERAS[shown].raw(REST, 7)))
        assert why.endswith(SWAPPED)


def test_a_calibration_without_a_light_refuses_no_gel_of_few_markers():
    left = CALIBRATED["left"]
    assert left.measured is not None
    older = replace(left, measured=replace(left.measured, light=""))
    assert learnt("left", "third", older)[0] == ""
    assert not shows(older, CAMERAS["left"].raw(REST, 7))
    unmeasured = replace(left, measured=None)
    assert learnt("left", "third", unmeasured) == ("", None)


def test_a_lamp_from_outside_makes_no_other_gel_of_a_print_that_is_the_own():
    used = load_scene("circle", camera__sensor="gelsight_mini", camera__noise_grey=2.7, camera__used_share=1.0)
    camera = Renderer(Appearance.draw(used, "left", 0))
    own = fit_camera(camera.raw(REST, 0), "left", MINI).camera
    lit = camera.raw(REST, 7) + np.linspace(0, 40, MINI.raw_width_px)[:, None]
    pixels = np.clip(lit, 0, 255).astype(np.uint8)
    image = Rectifier(own).apply(pixels)
    known = compared(own.measured, image, MarkerTracker().update(image, 0))
    assert known.apart is not None
    assert known.apart > 2 * OTHER_LIGHT, "otherwise this tests nothing"
    watch = TactileFinger("left", MINI.rectified, own, beside=CALIBRATED["right"])
    assert watch.learn_open(TactileFrame("left", 1, 1, pixels)) == ""


@pytest.mark.parametrize("finger", FINGERS)
def test_a_camera_is_examined_as_its_open_gel_is(finger: Finger):
    own, other = CALIBRATED[finger], CALIBRATED["right" if finger == "left" else "left"]
    for shown, camera in CAMERAS.items():
        assert doubt(own, other, camera.raw(REST, 7)) == learnt(finger, shown)[0]
    assert doubt(own, other, np.zeros(MINI.raw.shape, np.uint8)[1:]) == "", "a frame of another size is not judged here"


def test_a_calibration_without_a_light_says_so_where_its_markers_are_few():
    left, right = CALIBRATED["left"], CALIBRATED["right"]
    assert left.measured is not None
    assert right.measured is not None
    assert 24 < markers_n(left.measured.fingerprint) <= REST.shape[0] * REST.shape[1]
    assert untold(None) == untold(Calibration(left, right)) == ""
    older = [replace(one, measured=replace(one.measured, light="")) for one in (left, right) if one.measured]
    why = "calibrated without the light of the gel, so another gel is not noticed"
    assert untold(Calibration(older[0], right)) == f"left: {why}"
    assert untold(Calibration(*older)) == f"left and right: {why}"
    many = fingerprint(np.zeros((10, 15, 2)), np.ones((10, 15), np.bool_))
    assert markers_n(many) == TELLING_N
    without = replace(older[0], measured=replace(left.measured, light="", fingerprint=many))
    assert untold(Calibration(without, replace(right, measured=None))) == ""
    assert markers_n("") == 0


def test_a_frame_of_another_size_does_not_show_the_other_finger():
    raw = CAMERAS["left"].raw(REST, 7)
    assert shows(CALIBRATED["left"], raw)
    assert not shows(CALIBRATED["left"], raw[1:])


@pytest.mark.real_data
def test_real_gels_of_few_markers_are_told_by_their_light():
    """42 markers: the right gel's print is as like the left's as its own can be of another recording."""
    folder = real_data("gelsight_mini_slip")
    runs = [("blue_mug_1_hold", 16), ("ball_white_thread_2_hold", 12), ("cheese_tube_4_hold", 17)]
    still = {
        (run, camera): read_video(folder / run / f"camera_{camera}.avi")[k] for run, k in runs for camera in (0, 2)
    }
    image = still["blue_mug_1_hold", 0]
    grid = find_grid(image, "left", None)
    left = rectify(image, grid, profile_of(image, grid, "as_seen", 1.5, 10)).camera
    assert shows(left, still["ball_white_thread_2_hold", 0])
    assert not any(shows(left, still[run, 2]) for run, _ in runs)
    assert not shows(left, still["cheese_tube_4_hold", 0]), "the gel was changed"


def test_a_calibration_holds_the_light_of_its_gel():
    left, right = (CALIBRATED[finger].measured for finger in FINGERS)
    assert left is not None
    assert right is not None
    away = light_apart(left.light, right.light)
    assert away is not None
    assert away > OTHER_LIGHT
    assert light_apart(left.light, light_of(Rectifier(CALIBRATED["left"]).apply(CAMERAS["left"].raw(REST, 3)))) < 0.01


def test_a_picture_without_markers_is_called_no_other_gel():
    watch = TactileFinger("left", MINI.rectified, CALIBRATED["left"], beside=CALIBRATED["right"])
    dark = TactileFrame("left", 1, 1, np.zeros(MINI.raw.shape, np.uint8))
    assert "without markers" in watch.learn_open(dark)
    assert watch.explain(dark) == ""
