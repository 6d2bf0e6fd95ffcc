"""Domain randomisation: variations of an installation that no scene file can know."""

import math
from typing import Any

import numpy as np

from simulation.scene.scene import Scene

MODULUS = "gel.shear_modulus_n_per_mm2"
LEAST_HELD_MM = 6.0
ROUNDING_MM = 1e-9


def randomised(scene: Scene, rng: np.random.Generator, *, held_out: bool = False) -> Scene:
    """A domain-randomised copy of a scene.

    Grasp height above the object's bottom, weight, grip and clearance are drawn from the cell's full range. Sizes,
    frictions, stiffness, crown, grip, noise and light of held-out draws come from ranges that no training draw reaches.
    Where a scene states its own stiffness, friction, crown, grip or height, it becomes the middle of a range of the
    same relative width. Values scaled past the limits of a scene are clamped to the limit.
    """

    def draw(low: float, high: float, margin: float) -> float:
        if not held_out:
            return float(rng.uniform(low, high))
        outer = (low - margin, low) if rng.random() < 0.5 else (high, high + margin)
        return float(rng.uniform(*outer))

    body = scene.object
    scale = draw(0.9, 1.2, 0.05)
    regular = body.shape in {"hexagon", "ellipse"} and body.size_x_mm == body.size_y_mm  # or round; they stay so
    size_x = _size_mm(body.size_x_mm, scale, 110.0 if regular else 200.0)
    height = _around(scene, "grasp.height_mm", float(rng.uniform(25.0, 95.0)), 60.0)
    size_y = _size_mm(body.size_y_mm, scale * draw(0.96, 1.04, 0.04), 110.0)
    if body.vertices_mm and body.corner_radius_mm > 0.0:  # stretched one way, its arcs might not fit
        scale = min(size_x / body.size_x_mm, size_y / body.size_y_mm)
        size_x, size_y = body.size_x_mm * scale, body.size_y_mm * scale
    changes: dict[str, Any] = {
        "object.size_x_mm": size_x,
        "object.size_y_mm": size_y,
        "object.corner_radius_mm": min(50.0, 0.5 * size_x, 0.5 * size_y, body.corner_radius_mm * scale),
        "object.mass_kg": math.exp(float(rng.uniform(math.log(0.05), math.log(0.6)))),
        "object.centre_of_mass_height_mm": height * float(rng.uniform(0.4, 0.95)),
        "blocks.gap_mm": min(250.0, size_x + 2.0 * scene.clearance_mm / 2.5 * float(rng.uniform(1.5, 3.0))),
        "blocks.friction": _around(scene, "blocks.friction", draw(0.15, 0.35, 0.1), 0.25),
        "gel.friction": _around(scene, "gel.friction", draw(0.65, 0.95, 0.15), 0.8),
        "gel.shear_modulus_n_per_mm2": _around(scene, MODULUS, 0.1 * math.exp(draw(-0.2, 0.2, 0.15)), 0.1),
        "gel.crown_mm": min(_around(scene, "gel.crown_mm", draw(0.06, 0.18, 0.06), 0.12), 0.5 * scene.gel.thickness_mm),
        "grasp.force_n": _around(scene, "grasp.force_n", draw(16.0, 38.0, 4.0), 27.0),
        "grasp.height_mm": height,
        "camera.noise_grey": min(30.0, scene.camera.noise_grey * draw(0.5, 1.5, 0.4)),
        "camera.light": draw(0.85, 1.15, 0.15),
        "gel.wear": draw(0.1, 0.4, 0.1),
        "x_range_mm": min(60.0, scene.x_range_mm * scale),
    }
    if body.vertices_mm:
        scales = size_x / body.size_x_mm, size_y / body.size_y_mm
        changes["object.vertices_mm"] = [(x * scales[0], y * scales[1]) for x, y in body.vertices_mm]
    if regular:
        changes["object.size_y_mm"] = size_x
    return _with_held_corners(scene, changes)


def _with_held_corners(scene: Scene, changes: dict[str, Any]) -> Scene:
    """The changed scene; the corners of its held section stay alike, where a size of it follows the object's own."""
    own_mm = scene.object.held_corner_radius_mm
    sharp = scene.varied(changes | {"object.held_corner_radius_mm": 0.0})
    sizes = zip(sharp.object.held_sizes_mm, scene.object.held_sizes_mm, strict=True)
    return sharp.varied({"object.held_corner_radius_mm": min(50.0, own_mm * min(size / own for size, own in sizes))})


def _size_mm(own_mm: float, scale: float, most_mm: float) -> float:
    """A scaled size, at most that of a scene and, unless the object is smaller itself, as wide as can be held."""
    return min(most_mm - ROUNDING_MM, max(own_mm * scale, min(own_mm, LEAST_HELD_MM)))


def _around(scene: Scene, key: str, value: float, middle: float) -> float:
    """A drawn value, shifted to the scene's own value where it states one."""
    part, name = key.split(".")
    table = getattr(scene, part)
    own, field = getattr(table, name), type(table).model_fields[name]
    if name not in table.model_fields_set:
        return value
    (least,) = (bound.ge for bound in field.metadata if hasattr(bound, "ge"))
    (most,) = (bound.le for bound in field.metadata if hasattr(bound, "le"))
    return float(min(max(own * value / middle, least), most))
