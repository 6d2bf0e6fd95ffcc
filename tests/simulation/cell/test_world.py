"""The mechanics behind the live devices follow the arm and the clock."""

import threading

import numpy as np
import pytest

from simulation.cell.emulators.abb.motion import Pose, tool_down
from simulation.cell.world import World
from simulation.physics.quasistatic import QuasiStaticCell
from simulation.scene.worlds import load_scene

FRAMES_N = 12


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
