"""Every effect that is on without work to do gives bit for bit the same result as when it is off."""

import numpy as np
import pytest

from simulation.data.probe import run_probe
from simulation.optics.appearance import Appearance
from simulation.optics.renderer import Renderer
from simulation.scene.effects import EFFECTS, dropped_share
from simulation.scene.worlds import load_scene
from tests.simulation.scenes import UPRIGHT

FRAMES = ("gel", "slipping", "depth_mm", "block_motion")
FORCES = ("wrench", "in_hand")
AHEAD, ACROSS = (0.0, 0.0), (8.0, 5.0)  # mm, deg: straight into the gap; onto a block
# effect -> a descent in which it is on and has nothing to do, and what must not change by a bit where it is off
IDLE = {
    "gravity": (load_scene("rectangle", object__mass_kg=1e-9), ACROSS, FRAMES),  # weighs less than the solver resolves
    "inertia": (load_scene("rectangle"), AHEAD, FRAMES + FORCES),
    "edge_friction": (load_scene("rectangle", blocks__friction=0.0), ACROSS, FRAMES + FORCES),
    "free_blocks": (load_scene("rectangle"), AHEAD, FRAMES + FORCES),
    "gel_coupling": (load_scene("circle"), ACROSS, ("slipping", "depth_mm", "block_motion", *FORCES)),  # only drawn
    "poisson": (load_scene("rectangle"), ACROSS, FRAMES + FORCES),
    "gel_edges": (load_scene("rectangle"), ACROSS, FRAMES + FORCES),
    "relaxation": (load_scene("rectangle"), ACROSS, FRAMES + FORCES),
    "finger_compliance": (load_scene("rectangle"), ACROSS, FRAMES + FORCES),
}


@pytest.mark.parametrize("key", IDLE)
def test_physics_that_is_on_with_nothing_to_do_is_off_bit_for_bit(key: str) -> None:
    scene, error, outputs = IDLE[key]
    scene = scene.varied({key.replace("__", "."): value for key, value in UPRIGHT.items()})
    on, off = (run_probe(scene.varied({f"effects.{key}": switch}), *error, seed=1) for switch in ("on", "off"))
    for name in outputs:
        np.testing.assert_array_equal(getattr(on, name), getattr(off, name))


def test_a_coupled_gel_that_relaxes_by_nothing_is_elastic_bit_for_bit() -> None:
    scene = load_scene("rectangle", gel__tier="layer", gel__node_rows=8, gel__node_columns=8)
    on, off = (run_probe(scene.varied({"effects.relaxation": switch}), *ACROSS, seed=1) for switch in ("on", "off"))
    for name in FRAMES + FORCES:
        np.testing.assert_array_equal(getattr(on, name), getattr(off, name))


def test_friction_at_edges_that_are_not_met_is_off_bit_for_bit() -> None:
    scene = load_scene("rectangle", **UPRIGHT)
    on, off = (run_probe(scene.varied({"effects.edge_friction": switch}), *AHEAD, seed=1) for switch in ("on", "off"))
    assert on.outcome == off.outcome == "inserted"
    for name in FRAMES + FORCES:
        np.testing.assert_array_equal(getattr(on, name), getattr(off, name))


GEL = np.random.default_rng(7).uniform(-0.1, 0.1, (20, 21, 3)).astype(np.float32)
UNTOUCHED = GEL * np.array([1.0, 1.0, 0.0], np.float32)  # no pressure
# effect -> keys with which it is on and has nothing to do; the gel in a frame, and before it
STILL = {
    "gel_wear": ({"gel.wear": 0.0}, GEL, 0.5 * GEL),
    "object_texture": ({}, UNTOUCHED, 0.5 * UNTOUCHED),
    "motion_blur": ({}, GEL, GEL),
    "rolling_shutter": ({"camera.readout_ms": 10.0}, GEL, GEL),
    "used_sensor": ({"camera.used_share": 0.0}, GEL, 0.5 * GEL),
    "camera_noise": ({"camera.noise_grey": 0.0}, GEL, 0.5 * GEL),
}


@pytest.mark.parametrize("key", STILL)
def test_optics_that_are_on_with_nothing_to_do_are_off_bit_for_bit(key: str) -> None:
    changes, gel, before = STILL[key]
    frames = []
    for switch in ("on", "off"):
        scene = load_scene("vitamin").varied({**changes, f"effects.{key}": switch})
        frames.append(Renderer(Appearance.draw(scene, "left", 2)).raw(gel, 1, before))
    np.testing.assert_array_equal(*frames)


def test_a_camera_that_is_to_lose_none_loses_none_whether_the_effect_is_on_or_off() -> None:
    for switch in ("on", "off"):
        assert dropped_share(load_scene("circle").varied({"effects.dropped_frames": switch})) == 0.0


def test_every_effect_is_shown_on_with_nothing_to_do() -> None:
    assert set(IDLE) | set(STILL) | {"dropped_frames"} == {effect.key for effect in EFFECTS}


def test_a_cell_that_asks_for_no_used_sensor_keeps_its_identity_and_its_seeds() -> None:
    scene = load_scene("vitamin")
    assert "used" not in scene.identity_json()
    asked = [scene.varied(change) for change in ({"camera.used_share": 0.1}, {"effects.used_sensor": "on"})]
    assert len({scene.sha256, *(one.sha256 for one in asked)}) == 3
