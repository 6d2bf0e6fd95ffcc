"""The mechanics behind the live devices follow the arm and the clock."""

import threading
from types import SimpleNamespace

import numpy as np
import pytest

from robot_client.insertion.geometry import CellFrame, WorkPose
from simulation.cell.emulators.abb.motion import Pose, tool_down
from simulation.cell.world import HeldPart, World
from simulation.physics.quasistatic import QuasiStaticCell
from simulation.scene.worlds import load_scene

FRAMES_N = 12


class Recorder:
    """Mechanics that only note at what pace they are moved."""

    relaxes, pace_mm_s, tilt_rad, lost = False, 0.0, 0.0, False

    def __init__(self, gel):
        self.gel, self.paces_mm_s = gel, []

    def move_to(self, *_):
        self.paces_mm_s.append(self.pace_mm_s)
        return SimpleNamespace(gel=self.gel, grasp_lost=self.lost)


def test_the_mechanics_move_at_the_pace_of_the_arm(monkeypatch):
    now_ns = [0]
    monkeypatch.setattr("simulation.cell.world.time", SimpleNamespace(monotonic_ns=lambda: now_ns[0]))
    mechanics = Recorder(np.zeros((2, 20, 21, 3)))

    def pose():
        return Pose((0.0, 0.0, 100.0 - 8.0e-9 * now_ns[0]), tool_down(0.0))

    sensor = load_scene("rectangle").sensor
    world = World(mechanics, lambda *_: None, pose, sensor=sensor, fps=30.0)
    for _ in range(4):
        world.warm()
        now_ns[0] += 50_000_000
    assert mechanics.paces_mm_s[0] == 0.0, "where the arm was before, nobody knows"
    assert mechanics.paces_mm_s[1:] == pytest.approx([8.0] * 3)


def test_an_object_just_grasped_is_not_lost_because_the_one_before_it_was():
    """The gripper looks every 5 ms, the mechanics with the next picture: each further object was lost at once."""
    mechanics, home = Recorder(np.zeros((2, 20, 21, 3))), Pose((0.0, 0.0, 100.0), tool_down(0.0))
    world = World(mechanics, lambda *_: home, lambda: home, sensor=load_scene("rectangle").sensor, fps=30.0)
    part = HeldPart(world, 80.0, lambda: home, home, fed=True)
    mechanics.lost = True
    world.warm()
    assert part.lost()
    part.released()
    assert part.width_mm() == 80.0
    part.gripped(40.0)
    assert not part.lost()


def test_fingers_that_close_again_on_what_they_hold_do_not_grasp_it_anew():
    """As a client does that finds the gripper without a part: the object would hang upright again, and another one."""
    numbers, home = [], Pose((0.0, 0.0, 100.0), tool_down(0.0))

    def regrasp(_force_n, number):
        numbers.append(number)
        return home

    mechanics, sensor = Recorder(np.zeros((2, 20, 21, 3))), load_scene("rectangle").sensor
    world = World(mechanics, regrasp, lambda: home, sensor=sensor, fps=30.0, held=False)
    part = HeldPart(world, 80.0, lambda: home, home, fed=True)
    part.gripped(40.0)
    part.gripped(40.0)
    part.released()
    part.gripped(40.0)
    while not world._todo.empty():
        world._todo.get()()
    assert numbers == [0, 0]


@pytest.mark.parametrize("share", [0.0, 0.4])
def test_a_gel_that_relaxes_goes_on_creeping_while_the_arm_stands(share):
    scene = load_scene("rectangle", gel__relaxation_share=share, gel__relaxation_s=0.2)
    cell = QuasiStaticCell(scene, 0)
    cell.regrasp(8.0, 0.0)
    x, y, z, _ = cell.pose
    pressing = Pose((float(x), float(y), float(z) - 5.6), tool_down(0.0))
    world = World(cell, lambda _force_n, _part_n: pressing, lambda: pressing, sensor=scene.sensor, fps=30.0)
    gels, done = [], threading.Event()

    def shown(exposure):
        gels.append(exposure.gel)
        if len(gels) == FRAMES_N:
            done.set()

    world.on_exposure(shown)
    world.warm()
    pressed_n = world.state.wrench_n_nmm[2]
    world.start()
    assert done.wait(60.0)
    world.stop()
    assert world.error is None
    relaxed = 1.0 - world.state.wrench_n_nmm[2] / pressed_n
    if share:
        assert 0.5 * share < relaxed < share
    else:
        assert relaxed == 0.0
        assert np.array_equal(gels[0], gels[-1])


def test_the_object_is_tilted_with_the_arm_in_the_air_and_not_while_it_touches():
    scene = load_scene("rectangle", grasp__pre_tilt_spread_deg=0.0)
    cell = QuasiStaticCell(scene, 0)
    cell.regrasp(8.0, 0.0)
    x, y, z, _ = map(float, cell.pose)
    arm = [Pose((x, y, z), tool_down(0.0))]
    world = World(cell, lambda _force_n, _part_n: arm[0], lambda: arm[0], sensor=scene.sensor, fps=30.0)
    world.warm()
    level_mm = world.state.bottom_z_mm
    leaning = CellFrame().to_controller(WorkPose(x_mm=x, y_mm=y, z_mm=z, yaw_deg=0.0, tilt_deg=-1.2)).quaternion
    arm[0] = Pose((x, y, z), leaning)
    assert arm[0].lean_deg == pytest.approx(-1.2)
    world.warm()
    assert np.degrees(cell.tilt_rad) == pytest.approx(-1.2)
    half_mm = 0.5 * float(np.ptp(scene.object.footprint_mm[:, 0]))
    assert level_mm - world.state.bottom_z_mm == pytest.approx(half_mm * np.sin(np.radians(1.2)), abs=0.02)
    arm[0] = Pose((x, y, z - 6.5), leaning)
    world.warm()
    assert world.state.in_contact
    arm[0] = Pose((x, y, z - 6.5), tool_down(0.0))
    world.warm()
    assert np.degrees(cell.tilt_rad) == pytest.approx(-1.2)
