"""Which physical effects a scene needs.

Each is declared once, with the predicate that switches it on and the reason it gives.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from typing import NamedTuple

from simulation.scene import rubber
from simulation.scene.scene import GRAVITY_N_PER_KG, Scene


class Active(NamedTuple):
    """Switches of one scene."""

    gravity: bool
    inertia: bool
    edge_friction: bool
    free_blocks: bool
    gel_wear: bool
    gel_coupling: bool
    poisson: bool
    gel_edges: bool
    relaxation: bool
    finger_compliance: bool
    object_texture: bool
    motion_blur: bool
    rolling_shutter: bool
    camera_noise: bool
    used_sensor: bool
    dropped_frames: bool


@dataclass(frozen=True, slots=True)
class Effect:
    """One effect: its key in `scene.effects`, its description, and needed(scene) -> (whether, why)."""

    key: str
    what: str
    needed: Callable[[Scene], tuple[bool, str]]


def _above(key: str, limit: float) -> Callable[[Scene], tuple[bool, str]]:
    """Needed where a number of the scene exceeds a limit."""
    value_of = attrgetter(key)
    return lambda scene: (value_of(scene) > limit, f"{key} is {value_of(scene):g} (limit {limit:g})")


def _gravity(scene: Scene) -> tuple[bool, str]:
    share = scene.object.mass_kg * GRAVITY_N_PER_KG / (2.0 * max(scene.gel.friction, 1e-9) * scene.grasp.force_n)
    return share > 0.03, f"weight is {100.0 * share:.1f} % of what the grip can carry (limit 3 %)"


def inertia_share(scene: Scene) -> float:
    """Force of a sudden stop, v sqrt(m k), over the grip's capacity."""
    gel, sensor = scene.gel, scene.sensor
    area = sensor.gel_height_mm * sensor.gel_width_mm
    stiffness_n_per_m = 2.0 * gel.shear_modulus_n_per_mm2 / gel.thickness_mm * area * 1e3
    jolt_n = scene.speed_mm_s * 1e-3 * math.sqrt(scene.object.mass_kg * stiffness_n_per_m)
    return jolt_n / (2.0 * max(gel.friction, 1e-9) * scene.grasp.force_n)


def _inertia(scene: Scene) -> tuple[bool, str]:
    share = inertia_share(scene)
    return share > 0.1, f"a sudden stop loads the grip to {100.0 * share:.1f} % of what it can carry (limit 10 %)"


def _free_blocks(scene: Scene) -> tuple[bool, str]:
    return scene.blocks.free, "blocks.free is set" if scene.blocks.free else "blocks are fixed"


def _gel_coupling(scene: Scene) -> tuple[bool, str]:
    if scene.gel.tier == "layer":
        return False, "the layer tier couples by itself"
    reach, pitch_mm = 0.5 * scene.gel.thickness_mm, scene.sensor.marker_pitch_mm
    return reach > 0.3 * pitch_mm, f"rubber couples over {reach:.2f} mm, markers are {pitch_mm:.2f} mm apart"


def _poisson(scene: Scene) -> tuple[bool, str]:
    given, usual = scene.gel.poisson_ratio, rubber.poisson_ratio(max(scene.gel.normal_ratio, 2.0))
    if given is None:
        return False, f"gel.normal_ratio says it: {usual:.3g}"
    return abs(
        given - usual
    ) > 0.005, f"gel.poisson_ratio is {given:g}, gel.normal_ratio means {usual:.3g} (limit 0.005)"


def _edges(scene: Scene) -> tuple[bool, str]:
    beyond = rubber.margin_beyond_mm(scene)
    if beyond is None:
        return False, "gel.margin_mm is not given: endless"
    reach_mm = rubber.reach_in_thicknesses(rubber.poisson_of(scene)) * scene.gel.thickness_mm
    return min(beyond) < reach_mm, f"the gel ends {min(beyond):.2f} mm beyond the pad, rubber reaches {reach_mm:.1f} mm"


def _finger_compliance(scene: Scene) -> tuple[bool, str]:
    gel, finger, sensor = scene.gel, scene.grasp.finger_stiffness_n_per_mm, scene.sensor
    if finger == 0.0:
        return False, "grasp.finger_stiffness_n_per_mm is 0: rigid"
    pad = gel.shear_modulus_n_per_mm2 / gel.thickness_mm * sensor.gel_width_mm * sensor.gel_height_mm
    return pad / finger > 0.02, f"a finger gives by {100.0 * pad / finger:.1f} % of its sheared pad (limit 2 %)"


def _texture(scene: Scene) -> tuple[bool, str]:
    body = scene.object
    if body.texture_gain is not None:
        return body.texture_gain > 0.0, f"object.texture_gain is {body.texture_gain:g}"
    return body.texture != "smooth", f"object.texture is {body.texture}"


def _blur(scene: Scene) -> tuple[bool, str]:
    smear = scene.speed_mm_s * scene.camera.exposure_ms * 1e-3 / scene.sensor.mm_per_px
    return smear > 0.3, f"markers smear by up to {smear:.2f} px in an exposure (limit 0.3)"


def _rolling(scene: Scene) -> tuple[bool, str]:
    lag = scene.speed_mm_s * scene.camera.readout_ms * 1e-3 / scene.sensor.mm_per_px
    return lag > 0.3, f"the image moves by up to {lag:.2f} px while it is read out (limit 0.3)"


EFFECTS = (
    Effect("gravity", "weight of the held object", _gravity),
    Effect("inertia", "the held object's mass against sudden stops", _inertia),
    Effect("edge_friction", "friction at the blocks' edges and walls", _above("blocks.friction", 0.02)),
    Effect("free_blocks", "blocks that slide on the table and tip", _free_blocks),
    Effect("gel_wear", "worn spots and missing markers", _above("gel.wear", 0.02)),
    Effect("gel_coupling", "rubber between the bristles: coupled and bulging markers", _gel_coupling),
    Effect("poisson", "rubber that hardly changes its volume", _poisson),
    Effect("gel_edges", "free edges where the gel ends", _edges),
    Effect("relaxation", "rubber that gives way while its shape is held", _above("gel.relaxation_share", 0.01)),
    Effect("finger_compliance", "fingers that bend across the gap", _finger_compliance),
    Effect("object_texture", "imprint of the object's texture", _texture),
    Effect("motion_blur", "markers smeared within an exposure", _blur),
    Effect("rolling_shutter", "rows read one after another while the gel moves", _rolling),
    Effect("camera_noise", "grey-level noise", _above("camera.noise_grey", 0.0)),
    Effect("used_sensor", "uneven light, flares, glue, debris, poor print", _above("camera.used_share", 0.02)),
    Effect("dropped_frames", "frames that never arrive", _above("camera.dropped_share", 0.0)),
)


def decide(effect: Effect, scene: Scene) -> tuple[bool, str]:
    """Whether an effect is on for a scene, and why."""
    switch = getattr(scene.effects, effect.key)
    if switch != "auto":
        return switch == "on", f"forced {switch} by the scene"
    return effect.needed(scene)


def active_effects(scene: Scene) -> Active:
    return Active(**{effect.key: decide(effect, scene)[0] for effect in EFFECTS})


def dropped_share(scene: Scene) -> float:
    """Share of camera frames that never arrive, 0..1."""
    return scene.camera.dropped_share if active_effects(scene).dropped_frames else 0.0
