"""Effects of a world's keys on the arm and the cameras of the cell in lock step."""

from dataclasses import replace

import numpy as np
import pytest

from robot_client.insertion.events import Begin
from service.contract.shipped import released_models
from simulation.closed_loop.job import Job
from simulation.closed_loop.lockstep import LockstepCell
from simulation.closed_loop.play import models_of, stage
from simulation.scene.rubber import shear_reach_pitches
from simulation.scene.unstated import Unstated
from simulation.scene.worlds import load_scene
from tests.simulation.scenes import UPRIGHT


def cell(x_mm: float = 8.0, theta_deg: float = 5.0, unstated: dict[str, object] | None = None, **changes: object):
    scene = load_scene("rectangle", **UPRIGHT, **changes)
    return LockstepCell.build(scene, x_mm, theta_deg, 1, unstated=Unstated(**(unstated or {})), draws=False)


def descended(one: LockstepCell, frames: int) -> list[float]:
    """Height of the object's bottom as the left camera's frames show it."""
    one.descend(-25.0)
    heights = []
    for _ in range(frames):
        one.next_pair(look=False)
        heights.append(one.shots[1][0].bottom_z_mm)
    return heights


def test_a_hand_that_is_misplaced_holds_the_object_elsewhere_and_the_arm_says_what_it_was_told() -> None:
    wrong = cell(unstated={"tcp_offset_mm": (2.0, 0.0), "frame_yaw_deg": 3.0, "blocks_up_mm": 2.0})
    x, _, z, yaw = wrong.pose
    assert (z, yaw) == pytest.approx((35.0, 5.0))
    error_x, error_yaw = wrong.state.object_error
    tool, frame = np.radians(5.0), np.radians(3.0)
    assert error_yaw == pytest.approx(8.0)
    expected = np.cos(frame) * (x + 2.0 * np.cos(tool)) - np.sin(frame) * 2.0 * np.sin(tool)
    assert error_x == pytest.approx(expected, abs=0.05)
    assert wrong.state.bottom_z_mm == pytest.approx(3.0, abs=0.05)


@pytest.mark.parametrize(
    ("unstated", "left"), [({}, (3.0, 1.0)), ({"x_sign": -1}, (13.0, 1.0)), ({"yaw_sign": -1}, (3.0, 9.0))]
)
def test_a_correction_with_a_wrong_sign_moves_the_object_the_other_way(unstated, left) -> None:
    wrong = cell(unstated=unstated)
    x, y, z, yaw = wrong.pose
    wrong.travel(x - 5.0, y, z, yaw - 4.0, 1.0)
    assert wrong.pose == pytest.approx((x - 5.0, y, z, yaw - 4.0))
    assert wrong.state.object_error == pytest.approx(left, abs=0.05)


def test_a_late_camera_shows_what_was_and_stamps_it_as_new() -> None:
    now, late, half = (descended(cell(camera__latency_ms=ms), 12) for ms in (0.0, 100.0, 50.0))
    assert late[:3] == [late[0]] * 3
    assert late[3:] == pytest.approx(now[:-3])
    assert half[2:] == pytest.approx(np.interp(np.arange(12) - 1.5, np.arange(12), now)[2:], abs=1e-6)
    stamped = cell(camera__latency_ms=100.0)
    assert stamped.next_pair(look=False).left.captured_ns == stamped.now_ns


@pytest.mark.parametrize("fps", [10, 60.0, 120])
@pytest.mark.parametrize("speed_mm_s", [3.0, 40.0])
def test_frames_and_ways_follow_rate_and_speed(fps, speed_mm_s) -> None:
    heights = descended(cell(speed_mm_s=speed_mm_s, camera__fps=fps, camera__exposure_ms=5.0), 4)
    assert -np.diff(heights)[:1] == pytest.approx(speed_mm_s / fps, abs=1e-6) or speed_mm_s / fps > 1.0


def test_an_arm_that_was_told_to_hold_stands_from_the_end_of_its_lag_on() -> None:
    held = cell(unstated={"stop_lag_s": 0.05}, camera__fps=30.0, camera__latency_ms=0.0)
    held.descend(0.0)
    held.next_pair(look=False)
    held.hold()
    held.next_pair(look=False)
    assert (held.moving, held.still_s) == (True, 0.0)
    for frames in (2, 3):
        held.next_pair(look=False)
        assert held.still_s == pytest.approx(frames / 30.0 - 0.05, abs=1e-6)
    assert held.pose[2] == pytest.approx(35.0 - held.speed_mm_s * (1 / 30.0 + 0.05))


def test_a_descent_stands_once_its_lease_is_over_wherever_that_is_between_two_frames() -> None:
    held = cell(unstated={"stop_lag_s": 0.05}, camera__fps=10.0, camera__latency_ms=30.0)
    held.descend(0.0)
    held.stands_s = held.now_s + 0.08
    for _ in range(2):
        held.next_pair(look=False)
        assert held.pose[2] == pytest.approx(35.0 - held.speed_mm_s * 0.08)
    assert held.moving, "a newer lease would let it go on"
    held.hold()
    held.stands_s = np.inf
    held.next_pair(look=False)
    assert held.pose[2] == pytest.approx(35.0 - held.speed_mm_s * 0.08), "it stood already: its lag is over"
    assert not held.moving


def test_a_heavy_object_settles_while_the_arm_stands() -> None:
    for mass_kg, least_mm in ((0.1, 0.0), (2.0, 0.003)):
        stopped = cell(object__mass_kg=mass_kg, grasp__force_n=15.0)
        stopped.descend(stopped.pose[2] - 6.0)
        while stopped.moving:
            stopped.next_pair(look=False)
        places = [stopped.state.in_hand[0]]
        for _ in range(8):
            stopped.next_pair(look=False)
            places.append(stopped.state.in_hand[0])
        assert least_mm <= np.ptp(places) <= 2.0 * least_mm
        assert abs(places[-1] - places[-2]) < 1e-4


def test_a_gel_creeps_from_the_standstill_on_wherever_that_is_between_two_frames() -> None:
    """The arm stands 38 ms before the sixth frame at 10 a second, as at 100 a second; the way itself is stepped."""
    forces_n = []
    for fps in (10.0, 100.0):
        pressed = cell(theta_deg=0.0, camera__fps=fps, gel__relaxation_share=0.4, gel__relaxation_s=0.1)
        pressed.descend(pressed.pose[2] - 5.62)
        for _ in range(round(0.6 * fps)):
            pressed.next_pair(look=False)
        assert pressed.still_s == pytest.approx(0.038)
        forces_n.append(float(pressed.state.wrench_n_nmm[2]))
    assert forces_n[0] == pytest.approx(forces_n[1], rel=0.02)


def test_blocks_above_the_approach_are_run_into_and_not_jumped_into() -> None:
    hit = cell(unstated={"blocks_up_mm": 5.5})
    assert hit.state.in_contact
    assert 0.5 < np.linalg.norm(hit.state.wrench_n_nmm[:3]) < 60.0


def conditions(job: Job) -> tuple[float | None, float | None]:
    """Grip and shear reach that the service hears with `arm`."""
    insertion = stage(job, models_of(released_models()))
    insertion._post(Begin(at_s=0.0, pose=insertion._pose()))
    while insertion.session.attempt is None:
        insertion._frame()
    heard = insertion.session.attempt.conditions()
    return heard["grip_n"], heard["shear_reach_mm"]


def test_a_cell_that_measured_its_reach_tells_it_a_little_wrong_and_another_tells_none() -> None:
    job = Job("rectangle", 0, 8.0, 5.0, 1, "belief", "fields", changes={"grasp.force_n": 25.0})
    assert conditions(job) == (25.0, None)
    true_mm = shear_reach_pitches(job.build_scene()) * job.build_scene().sensor.marker_pitch_mm
    _, reach_mm = conditions(replace(job, given_reach=True))
    assert reach_mm != pytest.approx(true_mm, rel=1e-3)
    assert reach_mm == pytest.approx(true_mm, rel=0.6)


def test_a_gel_without_friction_has_no_reach_to_send() -> None:
    job = Job("rectangle", 0, 8.0, 5.0, 1, "belief", "fields", changes={"gel.friction": 0.0}, given_reach=True)
    assert stage(job, models_of(released_models())).state.plan.shear_reach_mm is None


def test_open_gels_are_seen_as_the_cameras_are_wired():
    scene = load_scene("rectangle", camera__noise_grey=0.0)

    def opened(**unstated):
        cell = LockstepCell.build(scene, 6.0, 0.0, seed=3, unstated=Unstated(**unstated), draws=True)
        pair = cell.open_pair()
        return pair.left.pixels, pair.right.pixels

    left, right = opened()
    assert not np.array_equal(left, right)
    np.testing.assert_array_equal(opened(swapped_fingers=True), (right, left))
    np.testing.assert_array_equal(opened(mirrored=(False, True)), (left, right[:, ::-1]))


def test_a_cell_whose_signs_are_known_straightens_what_another_has_to_regrasp() -> None:
    """A slippery gel lets the object turn by most of a degree in each press."""
    slow = {"ramps": {"descend": {"speed_mm_s": 5.0, "acceleration_mm_s2": 100.0, "jerk_mm_s3": 2000.0}}}
    job = Job("rectangle", 0, 8.0, 6.0, 5, "belief", "fields", changes={"gel.friction": 0.4}, client=slow)
    ends = {}
    for known in (True, False):
        insertion = stage(job, models_of(released_models()))
        plan = insertion.state.plan.model_copy(update={"signs_known": known})
        insertion.state = replace(insertion.state, plan=plan)
        outcome = insertion.run()
        assert outcome.inserted
        ends[known] = outcome.grasps, sum(outcome.seconds.values()), insertion.cell.tilt_deg
    assert ends[True][0] == 1
    assert 0.3 < abs(ends[True][2]) <= plan.limits.max_straighten_deg
    assert ends[False][0] == 3
    assert ends[False][2] == 0.0
    assert ends[True][1] < ends[False][1], "a regrasp takes longer"


def test_a_cell_that_was_not_commissioned_knows_no_signs_and_a_miswired_one_takes_them_for_known() -> None:
    """On a cell, too, a record without a mistake is all that the client has."""
    miswired = [({"mirrored": (True, False)}, True, True), ({"x_sign": -1}, True, True)]
    for unstated, commissioned, known in [({}, True, True), ({}, False, False), *miswired]:
        job = Job("rectangle", 0, 8.0, 6.0, 3, "belief", "fields", unstated=unstated, commissioned=commissioned)
        assert stage(job, models_of(released_models())).state.plan.signs_known == known
