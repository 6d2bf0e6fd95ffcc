"""Inertia of the held object: a mass on the gel's springs, without effect where the arm is slow."""

import numpy as np
import pytest

from simulation.data.probe import QuasiStaticCell, run_probe
from simulation.scene.effects import active_effects, inertia_share
from simulation.scene.worlds import load_scene, object_names
from tests.simulation.scenes import UPRIGHT


def test_an_object_that_is_stopped_swings_as_a_mass_on_the_gels_springs() -> None:
    """Amplitude v / omega and half period pi / omega, omega^2 = k / m; k is the stiffness of all pressed bristles."""
    scene = load_scene(
        "rectangle",
        speed_mm_s=100.0,
        effects__inertia="on",
        effects__gravity="off",
        object__mass_kg=1.0,
        object__centre_of_mass_height_mm=30.0,
        gel__friction=2.0,
        numerics__load_step_mm=0.01,
        **UPRIGHT,
    )
    cell = QuasiStaticCell(scene)
    cell.regrasp(0.0, 0.0)
    cell.coasting.velocity[:] = (0.0, 0.0, -5.0)
    heights = []
    for _ in range(250):
        cell.wait(1e-4)
        heights.append(float(cell.state["place"][2]))
    pressed = np.count_nonzero(cell.nodes["pressure"])
    omega = np.sqrt(1e3 * float(cell.constants["kt"][0] * cell.constants["area"][0]) * pressed / 1.0)
    assert -min(heights) == pytest.approx(5.0 / omega, rel=0.02)
    assert 1e-4 * int(np.argmax(np.array(heights) > 0.0)) == pytest.approx(np.pi / omega, rel=0.02)


@pytest.mark.parametrize("name", object_names())
def test_the_shipped_scenes_are_too_slow_and_light_for_inertia(name: str) -> None:
    scene = load_scene(name)
    assert inertia_share(scene) < 0.1
    assert not active_effects(scene).inertia
    assert QuasiStaticCell(scene).coasting is None


def test_speed_and_mass_call_for_inertia() -> None:
    scene = load_scene("mustard", speed_mm_s=60.0)
    assert active_effects(scene).inertia
    assert not active_effects(scene.varied({"speed_mm_s": 10.0})).inertia
    assert not active_effects(scene.varied({"object.mass_kg": 0.01})).inertia


def test_a_fast_heavy_object_still_moves_after_the_arm_has_stopped() -> None:
    heavy = {"object__mass_kg": 1.0, "speed_mm_s": 80.0, "camera__fps": 90, **UPRIGHT}
    fast, calm = (
        run_probe(load_scene("rectangle", effects__inertia=switch, **heavy), 9.0, 0.0) for switch in ("on", "off")
    )
    after = slice(calm.stop_frame, None)
    assert np.ptp(calm.in_hand[after, 2]) == 0.0
    assert np.ptp(fast.in_hand[fast.stop_frame :, 2]) > 0.01


def test_an_object_that_is_lowered_steadily_in_creeping_gels_weighs_what_it_weighs() -> None:
    """Before any contact: at constant speed only gravity pulls at it."""
    scene = load_scene(
        "rectangle",
        speed_mm_s=25.0,
        effects__inertia="on",
        effects__gravity="on",
        object__mass_kg=0.4,
        gel__relaxation_share=0.3,
        gel__relaxation_s=0.6,
        **UPRIGHT,
    )
    cell = QuasiStaticCell(scene)
    cell.regrasp(0.0, 0.0)
    x_mm, y_mm, z_mm, yaw_rad = cell.pose
    forces_n = [
        -cell.move_to(x_mm, y_mm, z_mm - 0.25 * step, np.degrees(yaw_rad)).wrench_n_nmm[2] for step in range(1, 17)
    ]
    assert forces_n[-8:] == pytest.approx([scene.object.mass_kg * 9.81] * 8, rel=0.01)


@pytest.mark.parametrize("pace_mm_s", [10.0, 1.0])
def test_with_inertia_a_move_takes_as_long_as_the_arm_takes(pace_mm_s: float) -> None:
    """At these speeds the mass itself does not count: the gel creeps, and bears as much, as without inertia."""
    forces_n = []
    for switch in ("off", "on"):
        creeps = {"gel__relaxation_share": 0.4, "gel__relaxation_s": 0.5, "effects__inertia": switch}
        cell = QuasiStaticCell(load_scene("rectangle", **creeps, **UPRIGHT))
        cell.regrasp(8.0, 0.0)
        cell.pace_mm_s = pace_mm_s
        x_mm, y_mm, z_mm, yaw_rad = cell.pose
        cell.move_to(x_mm, y_mm, z_mm - 4.0, np.degrees(yaw_rad))
        if cell.coasting is not None:
            assert cell.coasting.velocity == pytest.approx([0.0, 0.0, -pace_mm_s])
        forces_n.append(cell.move_to(x_mm, y_mm, z_mm - 5.6, np.degrees(yaw_rad)).wrench_n_nmm[2])
    assert forces_n[1] == pytest.approx(forces_n[0], rel=1e-3)
