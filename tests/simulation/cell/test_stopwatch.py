"""A stop is timed to its last lowered target: a retract that begins before the arm rests is no part of it."""

import time

import pytest

from simulation.cell.emulators.abb.cabinet import Cabinet
from simulation.cell.emulators.abb.motion import Follower, MotionLimits, Pose
from simulation.cell.emulators.faults import FaultBoard
from simulation.cell.emulators.stopwatch import StopWatch

CYCLE_S = 0.004


@pytest.mark.parametrize("lag_s", [0.02, 0.05])
@pytest.mark.parametrize("pause_cycles", [10, 40, 200])
def test_the_freeze_is_the_last_lowered_target_whatever_the_lag_and_however_soon_the_arm_goes_up(lag_s, pause_cycles):
    arm = Follower(Pose((5.0, 0.0, 40.0)), MotionLimits(lag_s=lag_s))
    arm.braking = False
    watch = StopWatch(Cabinet(arm, FaultBoard()))
    frozen_ns = 0
    for k in range(100 + pause_cycles + 100):
        z = 40.0 - 0.04 * min(k, 100) + (0.1 * (k - 100 - pause_cycles) if k > 100 + pause_cycles else 0.0)
        arm.target = Pose((5.0, 0.0, z))
        arm.advance(CYCLE_S)
        watch()
        frozen_ns = time.monotonic_ns() if k == 100 else frozen_ns
    (stop,) = watch.stops
    assert stop.frozen_ns <= frozen_ns < stop.rest_ns
    assert stop.overtravel_mm == pytest.approx(10.0 * lag_s, abs=0.06 if pause_cycles > 10 else 0.3)
