"""The speed at which a played arm probes."""

from pathlib import Path

import pytest

from robot_client.insertion.lease import Lease
from simulation.closed_loop.client import PROBING_MM_S
from simulation.closed_loop.job import Job
from simulation.closed_loop.play import models_of, stage
from simulation.studies.pace.points import ramp

MODELS = Path(__file__).parents[3] / "models" / "pressing"


@pytest.mark.parametrize(
    ("stated", "fps", "client", "probes"),
    [
        (28.8, 30, {}, PROBING_MM_S),
        (4.0, 30, {}, 4.0),
        (28.8, 10, {}, Lease().fastest_mm_s(10.0)),
        (28.8, 30, {"ramps": {"descend": ramp(12.0, 100.0, 2000.0)}}, 12.0),
    ],
)
def test_a_quick_arm_and_slow_cameras_slow_it_down_a_slow_one_keeps_its_speed_and_a_client_has_its_own(
    stated, fps, client, probes
):
    changes = {"speed_mm_s": stated, "camera.fps": fps}
    job = Job("rectangle", 0, 9.0, 4.0, 3, "belief", "fields", "", changes, client=client)
    played = stage(job, models_of(MODELS))
    assert played.state.plan.ramps.descend.speed_mm_s == probes
    assert played.cell.speed_mm_s == probes


@pytest.mark.parametrize(("friction", "stays"), [(0.4, True), (0.6, False)])
def test_the_played_client_states_whether_the_blocks_of_its_scene_stay(friction, stays):
    changes = {"blocks.free": True, "blocks.friction": friction, "blocks.mass_kg": 0.1}
    played = stage(Job("rectangle", 0, 9.0, 4.0, 3, "belief", "fields", "", changes), models_of(MODELS))
    assert played.state.plan.neighbours_stay == stays
