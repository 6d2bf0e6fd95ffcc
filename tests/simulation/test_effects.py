"""Effects: what is off costs nothing and changes nothing; predicates tell where leaving one out would matter."""

import numpy as np
import pytest

from simulation.effects import EFFECTS, active_effects, decide
from simulation.probe import Probe, run_probe
from simulation.scene import Scene, load_scene

CLEAN = {"grasp__pre_tilt_spread_deg": 0.0, "grasp__pre_yaw_spread_deg": 0.0}
NOISE_MM = 0.005  # markers are tracked to some 0.05 px


def poke(scene: Scene) -> Probe:
    return run_probe(scene, 8.0, 5.0, seed=1)


def difference(scene: Scene, key: str) -> float:
    """RMS marker difference, mm, between a scene with an effect forced on and forced off, over the contact."""
    one, other = (poke(scene.varied({f"effects.{key}": switch})) for switch in ("on", "off"))
    frames = min(len(one.gel), len(other.gel))
    first = one.onset_frame
    if one.stop_frame != other.stop_frame:
        return float("inf")
    moved = [(p.gel[first:frames] - p.gel[first - 2]).astype(np.float64)[..., :2] for p in (one, other)]
    return float(np.sqrt(np.mean((moved[0] - moved[1]) ** 2)))


@pytest.mark.parametrize(
    ("key", "calls_for_it", "does_without"),
    [
        ("gravity", load_scene("mustard", **CLEAN), load_scene("rectangle", object__mass_kg=0.01, **CLEAN)),
        ("edge_friction", load_scene("rectangle", **CLEAN), load_scene("rectangle", blocks__friction=0.005, **CLEAN)),
        (
            "free_blocks",
            load_scene("circle", blocks__free=True, blocks__table_friction=0.01, blocks__mass_kg=0.2, **CLEAN),
            load_scene("circle", **CLEAN),
        ),
        ("gel_coupling", load_scene("circle", **CLEAN), load_scene("circle", gel__thickness_mm=0.5, **CLEAN)),
    ],
)
def test_a_predicate_tells_where_the_effect_matters(key: str, calls_for_it: Scene, does_without: Scene) -> None:
    assert getattr(active_effects(calls_for_it), key)
    assert not getattr(active_effects(does_without), key)
    assert difference(calls_for_it, key) > NOISE_MM


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.key)
def test_a_forced_switch_is_obeyed(effect) -> None:
    scene = load_scene("can")
    for switch in ("on", "off"):
        on, why = decide(effect, scene.varied({f"effects.{effect.key}": switch}))
        assert on == (switch == "on")
        assert why == f"forced {switch} by the scene"


def test_an_effect_that_is_off_leaves_the_rest_bit_for_bit() -> None:
    scene = load_scene("rectangle")
    assert not active_effects(scene).gravity
    np.testing.assert_array_equal(poke(scene).gel, poke(scene.varied({"effects.gravity": "off"})).gel)
    np.testing.assert_array_equal(poke(scene).wrench, poke(scene.varied({"effects.gel_coupling": "off"})).wrench)
