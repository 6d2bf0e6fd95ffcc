"""The mechanics behind the live devices follow the arm and the clock."""

import threading
from types import SimpleNamespace

import numpy as np
import pytest

from simulation.cell.emulators.abb.motion import Pose, tool_down
from simulation.cell.world import World
from simulation.physics.quasistatic import QuasiStaticCell
from simulation.scene.worlds import load_scene

FRAMES_N = 12


class Recorder:
    """Mechanics that only note at what pace they are moved."""

    relaxes, pace_mm_s = False, 0.0

    def __init__(self, gel):
        self.gel, self.paces_mm_s = gel, []

    def move_to(self, *_):
        self.paces_mm_s.append(self.pace_mm_s)
        return SimpleNamespace(gel=self.gel, grasp_lost=False)


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
