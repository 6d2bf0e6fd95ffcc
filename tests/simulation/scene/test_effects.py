"""Effects: each matters in one scene and not in another, and its predicate distinguishes the two.

What is off is not even called, and leaves the outputs of all others bit for bit as they are.
"""

import asyncio
import json
import subprocess
import sys
from unittest import mock

import numpy as np
import pytest

from simulation.cell.emulators.camera import CameraEmulator, Shot
from simulation.cell.emulators.faults import FaultBoard
from simulation.closed_loop.lockstep import LockstepCell
from simulation.data.probe import Probe, run_probe
from simulation.optics import renderer, texture, used
from simulation.optics.appearance import Appearance
from simulation.optics.renderer import Renderer
from simulation.scene.effects import EFFECTS, active_effects, decide, dropped_share
from simulation.scene.scene import Scene
from simulation.scene.worlds import load_scene
from tests.simulation.scenes import UPRIGHT

NOISE_MM = 0.005  # markers are tracked to some 0.05 px
NOISE_GREY = 1.4  # RMS: what a camera noise of 2 grey levels leaves in a rectified frame


def poke(scene: Scene) -> Probe:
    return run_probe(scene, 8.0, 5.0, seed=1)


def marker_difference(one: Scene, other: Scene) -> float:
    """RMS difference, mm, of the markers' motion since before the contact; infinite where the descents end apart."""
    probes = [poke(scene) for scene in (one, other)]
    if probes[0].stop_frame != probes[1].stop_frame or probes[0].outcome != probes[1].outcome:
        return float("inf")
    first = max(2, probes[0].onset_frame)
    moved = [(probe.gel[first:] - probe.gel[first - 2]).astype(np.float64)[..., :2] for probe in probes]
    return float(np.sqrt(np.mean((moved[0] - moved[1]) ** 2)))


def image_difference(one: Scene, other: Scene) -> float:
    """RMS difference in grey levels of a frame in which the gel moves as fast as the arm."""
    state = poke(load_scene("rectangle", **UPRIGHT)).gel[-1, 0].astype(np.float32)
    fall = one.speed_mm_s / one.fps
    before = state - np.array([0.0, fall, 0.0], np.float32)
    frames = [Renderer(Appearance.draw(scene, "left", 3)).rectified(state, 5, before) for scene in (one, other)]
    return float(np.sqrt(np.mean((frames[0].astype(float) - frames[1]) ** 2)))


def frames_lost(one: Scene, other: Scene) -> float:
    """Difference of the shares of 200 frames that two cameras' streams lose."""

    async def lost(scene: Scene) -> float:
        camera = CameraEmulator("left", FaultBoard(), dropped_share(scene))
        for seq in range(200):
            await camera.publish(Shot(b"", seq, seq))
        return 1.0 - camera.published / 200

    return abs(asyncio.run(lost(one)) - asyncio.run(lost(other)))


LOOSE = {"blocks__table_friction": 0.01, "blocks__mass_kg": 0.2}
BOLTED = {"blocks__table_friction": 2.0, "blocks__mass_kg": 20.0}
HEAVY = {"object__mass_kg": 0.6, "grasp__force_n": 30.0, "camera__fps": 90}
# effect -> how far two scenes differ, what is noise there, a scene that calls for it, one that does without
CASES = {
    "gravity": (marker_difference, NOISE_MM, load_scene("mustard"), load_scene("rectangle", object__mass_kg=0.01)),
    "inertia": (
        marker_difference,
        NOISE_MM,
        load_scene("rectangle", speed_mm_s=100.0, **HEAVY),
        load_scene("rectangle", speed_mm_s=5.0, **HEAVY),
    ),
    "edge_friction": (
        marker_difference,
        NOISE_MM,
        load_scene("rectangle"),
        load_scene("rectangle", blocks__friction=0.005),
    ),
    "free_blocks": (
        marker_difference,
        NOISE_MM,
        load_scene("circle", blocks__free=True, **LOOSE),
        load_scene("circle", blocks__free=False, **BOLTED),
    ),
    "gel_coupling": (marker_difference, NOISE_MM, load_scene("circle"), load_scene("rectangle", gel__thickness_mm=0.3)),
    "poisson": (
        marker_difference,
        NOISE_MM,
        load_scene("rectangle", gel__poisson_ratio=0.48),
        load_scene("rectangle", gel__poisson_ratio=0.254),
    ),
    "gel_edges": (
        marker_difference,
        NOISE_MM,
        load_scene("rectangle", gel__margin_mm=(0.0, 0.0)),
        load_scene("rectangle", gel__margin_mm=(14.0, 14.0)),
    ),
    "relaxation": (
        marker_difference,
        NOISE_MM,
        load_scene("rectangle", gel__relaxation_share=0.4, gel__relaxation_s=0.1),
        load_scene("rectangle", gel__relaxation_share=0.005, gel__relaxation_s=0.1),
    ),
    "finger_compliance": (
        marker_difference,
        NOISE_MM,
        load_scene("circle", grasp__finger_stiffness_n_per_mm=20.0),
        load_scene("circle", grasp__finger_stiffness_n_per_mm=1e4),
    ),
    "gel_wear": (
        image_difference,
        NOISE_GREY,
        load_scene("circle", gel__wear=0.3),
        load_scene("circle", gel__wear=0.01),
    ),
    "object_texture": (
        image_difference,
        NOISE_GREY,
        load_scene("rectangle", object__texture="ribbed"),
        load_scene("rectangle", object__texture="smooth"),
    ),
    "motion_blur": (
        image_difference,
        NOISE_GREY,
        load_scene("rectangle", camera__exposure_ms=16.0),
        load_scene("rectangle", speed_mm_s=1.0),
    ),
    "rolling_shutter": (
        image_difference,
        NOISE_GREY,
        load_scene("rectangle", camera__readout_ms=20.0),
        load_scene("rectangle", camera__readout_ms=1.0),
    ),
    "used_sensor": (
        image_difference,
        NOISE_GREY,
        load_scene("circle", camera__used_share=0.2),
        load_scene("circle", camera__used_share=0.01),
    ),
    "camera_noise": (image_difference, 0.5, load_scene("circle"), load_scene("circle", camera__noise_grey=0.0)),
    "dropped_frames": (frames_lost, 0.1, load_scene("circle", camera__dropped_share=0.2), load_scene("circle")),
}


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.key)
def test_a_predicate_tells_where_the_effect_matters(effect) -> None:
    difference, noise, calls_for_it, does_without = CASES[effect.key]
    calls_for_it, does_without = (
        scene.varied({"grasp.pre_tilt_spread_deg": 0.0, "grasp.pre_yaw_spread_deg": 0.0})
        for scene in (calls_for_it, does_without)
    )
    assert getattr(active_effects(calls_for_it), effect.key)
    assert not getattr(active_effects(does_without), effect.key)
    matters, does_not = (
        difference(*(scene.varied({f"effects.{effect.key}": switch}) for switch in ("on", "off")))
        for scene in (calls_for_it, does_without)
    )
    assert matters > noise
    assert does_not < noise


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.key)
def test_a_forced_switch_is_obeyed(effect) -> None:
    scene = load_scene("can")
    for switch in ("on", "off"):
        on, why = decide(effect, scene.varied({f"effects.{effect.key}": switch}))
        assert on == (switch == "on")
        assert why == f"forced {switch} by the scene"


@pytest.mark.slow
def test_physics_that_is_off_is_not_even_called() -> None:
    """The kernels run as plain Python in another process, with every call counted, effects on and off."""
    module = [sys.executable, "-m", "tests.simulation.closed_loop.count_calls"]
    counts = json.loads(subprocess.run(module, capture_output=True, text=True, check=True).stdout)
    for key, (called, uncalled) in counts.items():
        assert called > 0, key
        assert uncalled == 0, key
    assert set(counts) == IN_THE_PHYSICS


IN_THE_PHYSICS = {
    *("gravity", "inertia", "edge_friction", "free_blocks", "gel_coupling"),
    *("poisson", "gel_edges", "relaxation", "finger_compliance"),
}
IN_THE_PICTURE = {
    "gel_wear": [(texture, "worn_spots")],
    "object_texture": [(texture, "relief"), (Renderer, "_bumps")],
    "motion_blur": [(Renderer, "_blurred")],
    "rolling_shutter": [(renderer, "_rolled")],
    "camera_noise": [(renderer, "_noise")],
    "used_sensor": [(used, "light_grey"), (used, "dots_off_px"), (used, "soiled")],
}


def look_of(key: str, switch: str) -> Appearance:
    """The left finger of a scene in which only this effect's switch differs."""
    given = {"camera__readout_ms": 10.0} | ({"camera__used_share": 0.5} if key == "used_sensor" else {})
    scene = load_scene("vitamin", **given).varied({f"effects.{key}": switch})
    return Appearance.draw(scene, "left", 2)


@pytest.mark.parametrize("key", IN_THE_PICTURE)
def test_optics_that_are_off_are_not_called_from_the_making_of_a_finger_to_its_frames(key: str) -> None:
    gel = np.full((20, 21, 3), 0.05, np.float32)
    for home, name in IN_THE_PICTURE[key]:
        with mock.patch.object(home, name, autospec=True, side_effect=getattr(home, name)) as own:
            Renderer(look_of(key, "off")).raw(gel, 1, 0.5 * gel)
            assert own.call_count == 0, name
            Renderer(look_of(key, "on")).raw(gel, 1, 0.5 * gel)
            assert own.call_count == 1, name


def test_motion_is_not_looked_at_where_neither_blur_nor_shutter_needs_it() -> None:
    gel = np.full((20, 21, 3), 0.05, np.float32)
    with mock.patch.object(Renderer, "_motion_since", autospec=True, side_effect=Renderer._motion_since) as own:
        for share in (0.0, 0.3):
            Renderer(Appearance(motion_blur_share=share)).raw(gel, 1, 0.5 * gel)
        assert own.call_count == 1


def test_every_effect_is_shown_to_call_nothing_when_off() -> None:
    assert IN_THE_PHYSICS | set(IN_THE_PICTURE) | {"dropped_frames"} == {effect.key for effect in EFFECTS}


@pytest.mark.parametrize("key", ["gel_wear", "object_texture"])
def test_what_is_not_drawn_on_a_finger_leaves_the_rest_of_it_bit_for_bit(key: str) -> None:
    on, off = (Renderer(look_of(key, switch)) for switch in ("on", "off"))
    np.testing.assert_array_equal(on._light, off._light)
    np.testing.assert_array_equal(on._surround, off._surround)
    if key == "object_texture":
        assert off._relief is None
        np.testing.assert_array_equal(on._albedo, off._albedo)
    else:
        assert off._relief is not None
        np.testing.assert_array_equal(on._relief, off._relief)
        assert 0.2 < np.mean(on._albedo == off._albedo) < 1.0, "cloth and dots stay where nothing is worn"


def test_a_camera_that_loses_no_frames_draws_no_lots() -> None:
    async def lots(share: float) -> int:
        with mock.patch.object(CameraEmulator, "_loses", return_value=False) as own:
            await CameraEmulator("left", FaultBoard(), share).publish(Shot(b"", 0, 0))
            return own.call_count

    scene = load_scene("circle", camera__dropped_share=0.2)
    calls = [asyncio.run(lots(dropped_share(scene.varied({"effects.dropped_frames": x})))) for x in ("on", "off")]
    assert calls == [1, 0]


def test_the_lock_step_cameras_drop_frames_only_where_the_switch_is_on() -> None:
    scene = load_scene("circle", camera__dropped_share=0.5)
    came = {}
    for switch in ("on", "off"):
        world = LockstepCell.build(scene.varied({"effects.dropped_frames": switch}), 8.0, 5.0, 3, draws=False)
        came[switch] = []
        for _ in range(50):
            world.next_pair(look=False)
            came[switch].append(world.arrived())
    assert 0.3 < np.mean(came["on"]) < 0.7
    assert np.all(came["off"])


def optics(scene: Scene) -> dict[str, object]:
    return Appearance.draw(scene, "left", 2).as_dict()


OPTICS = {
    "gel_wear": ({"worn", "missing_dots_share"}, {}),
    "object_texture": ({"object_texture_gain"}, {}),
    "motion_blur": ({"motion_blur_share"}, {}),
    "rolling_shutter": ({"rolling_share"}, {"camera.readout_ms": 10.0}),
    "camera_noise": ({"noise_sigma_grey"}, {}),
}


@pytest.mark.parametrize("key", OPTICS)
def test_a_switch_reaches_the_optics_and_nothing_else(key: str) -> None:
    fields, changes = OPTICS[key]
    on, off = (optics(load_scene("vitamin").varied({**changes, f"effects.{key}": switch})) for switch in ("on", "off"))
    assert {name for name in on if on[name] != off[name]} == fields
    assert all(off[name] == 0.0 for name in fields)


def test_optics_that_are_off_leave_the_physics_bit_for_bit() -> None:
    scene = load_scene("rectangle", **UPRIGHT)
    drawn, plain = poke(scene), poke(scene.varied({f"effects.{key}": "off" for key in (*OPTICS, "dropped_frames")}))
    np.testing.assert_array_equal(drawn.gel, plain.gel)
    np.testing.assert_array_equal(drawn.wrench, plain.wrench)
