"""The foreign cell's own pictures: read by the service's tracker, distinguished from those of an open gel."""

import numpy as np
import pytest

from service.contract import FINGERS, FramePair, TactileFrame, wire
from service.perception.finger import TactileFinger
from service.perception.rectification import Calibration
from service.session.factory import make_session
from simulation.closed_loop.cameras import foreign_cameras
from simulation.foreign.cell import ForeignCell
from simulation.foreign.pictures import Camera
from simulation.scene.worlds import load_scene
from tests.service import drawn


@pytest.fixture(scope="module")
def held():
    return ForeignCell(load_scene("circle")).look().gel


@pytest.fixture(scope="module")
def camera():
    return Camera(load_scene("circle").sensor, seed=3)


@pytest.mark.slow
def test_the_tracker_reads_how_far_the_markers_went(held, camera):
    finger = TactileFinger("left", camera.sensor.rectified, camera.calibration)
    opened = camera.raw(np.zeros_like(held[0]), 1)
    assert finger.learn_open(TactileFrame("left", 1, 1, opened)) == ""
    finger.rearm()
    observation = finger.observe(TactileFrame("left", 2, 2, camera.raw(held[0], 2, held[0])))
    assert observation.touch > 1.0
    truth = held[0, ..., :2] / camera.sensor.mm_per_px
    went = observation.field.rest_px + observation.field.displacement_px - camera.sensor.marker_rest_px()
    good = observation.field.valid
    assert good.mean() > 0.95
    assert np.sqrt(np.square(went - truth)[good].sum(-1).mean()) < 0.6  # dots are printed off their places by 0.5 px


def test_the_same_seed_draws_the_same_bits_and_a_slope_turns_to_its_light(held, camera):
    assert np.array_equal(camera.raw(held[0], 5), camera.raw(held[0], 5))
    tilted = np.zeros_like(held[0])
    tilted[..., 3] = np.linspace(0.0, 2.0, tilted.shape[1])  # pressed in to the right: it faces the right, red light
    change = camera.raw(tilted, 5).astype(float).mean((0, 1)) - camera.raw(np.zeros_like(tilted), 5).mean((0, 1))
    assert change[2] > 2.0
    assert change[1] < -2.0


def test_no_two_insertions_one_after_the_other_share_a_camera():
    scene = load_scene("circle")
    cameras = [camera for seed in (3, 4) for camera in foreign_cameras(scene, seed)]
    assert len({camera.calibration.homography.tobytes() for camera in cameras}) == 4


def test_a_gel_of_another_shape_is_refused(camera):
    with pytest.raises(ValueError, match=r"shape \[3, 3, 3\], expected \["):
        camera.raw(np.zeros((3, 3, 3)), 1)


def test_a_flat_face_that_the_pictures_hardly_show_is_held_until_it_is_gone(models):
    """It covers both gels: no picture reaches the touch limit, so the markers show whether it is still there."""
    scene = load_scene("rectangle")
    cameras = [Camera(scene.sensor, seed) for seed in (3, 4)]
    held = ForeignCell(scene).look().gel
    session = make_session(models, Calibration(*(camera.calibration for camera in cameras)))
    session.handle(wire.ClientHello(insertion_id="flat", client="test"), 0)
    session.handle(wire.LearnOpen(insertion_id="flat"), 0)
    lost = []
    for index in range(11):
        stamp_ns = index * drawn.PERIOD_NS
        gels = held if 1 <= index < 8 else np.zeros_like(held)
        frames = [
            TactileFrame(finger, index, stamp_ns, camera.raw(gel, index))
            for finger, camera, gel in zip(FINGERS, cameras, gels, strict=True)
        ]
        answers = session.on_pair(FramePair(*frames), stamp_ns)
        lost += [index for answer in answers if getattr(answer, "code", "") == "part_lost"]
        if index == 0:
            session.handle(wire.Arm(insertion_id="flat", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0), 1)
        if index == 1:
            assert [answer.type for answer in answers] == ["armed"]
            session.handle(wire.Descending(insertion_id="flat", attempt=1, speed_mm_s=10.0), stamp_ns)
    assert lost == [9]
