"""Formulas of rubber that scenes, effects and physics share: ratios, reaches, the shear reach."""

import math

import numpy as np
from numpy.typing import NDArray

from simulation.scene.scene import Scene


def poisson_ratio(normal_ratio: float) -> float:
    """Poisson's ratio at which a thin bonded layer is normal_ratio times as stiff along its normal as in shear.

    Oedometric over shear modulus is 2 (1 - nu) / (1 - 2 nu).
    """
    return (normal_ratio - 2.0) / (2.0 * normal_ratio - 2.0)


def poisson_of(scene: Scene) -> float:
    """A scene's Poisson's ratio, stated directly or as a ratio of stiffnesses."""
    given = scene.gel.poisson_ratio
    return poisson_ratio(scene.gel.normal_ratio) if given is None else given


def normal_ratio(poisson: float) -> float:
    """Oedometric over shear modulus, the inverse of `poisson_ratio`; infinite at 0.5."""
    return 2.0 * (1.0 - poisson) / (1.0 - 2.0 * poisson) if poisson < 0.5 else math.inf


def flow_length(poisson: float) -> float:
    """Distance over which pressure in a bonded layer drives rubber along it, in thicknesses: sqrt((M - E) / (12 G)).

    Pressure of a compressed layer obeys (M - E) t^2 / (12 G) lap(p) = p - (M - E) strain (Gent and Meinecke 1970 for
    incompressible rubber, Lindley 1979 with K in place of M - E, to which it tends towards 0.5).
    """
    return math.sqrt((normal_ratio(poisson) - 2.0 * (1.0 + poisson)) / 12.0) if poisson < 0.5 else math.inf


def reach_in_thicknesses(poisson: float) -> float:
    """Distance at which a layer's load has no effect: exp(-pi / 2) per thickness, exp(-1) per flow length, to 0.2 %."""
    return min(max(4.0, 6.2 * flow_length(poisson)), 24.0)


def margin_beyond_mm(scene: Scene) -> tuple[float, float] | None:
    """Extent of the gel beyond the pad that its profile states, (u, v), negative where it ends before; or None.

    None: no margin is stated, the gel counts as endless.
    """
    margin, sensor = scene.gel.margin_mm, scene.sensor
    if margin is None:
        return None
    span_u = (sensor.marker_columns - 1) * sensor.marker_pitch_mm
    span_v = (sensor.marker_rows - 1) * sensor.marker_pitch_mm
    return margin[0] - 0.5 * (sensor.gel_width_mm - span_u), margin[1] - 0.5 * (sensor.gel_height_mm - span_v)


def shear_reach_pitches(scene: Scene) -> float:
    """Shear of the gel at which it slides, in marker pitches: mu p t / G over the pitch.

    The pressure p is the grip over the area that the held surface touches flat: its width between the fingers, at most
    the pad's, times the pad's height. Where that surface is curved or slanted, the pad wraps around it up to its mean
    indentation: half a thickness of the gel counts as flat.
    """
    gel, sensor = scene.gel, scene.sensor
    area_mm2 = touched_width_mm(scene) * sensor.gel_height_mm
    shear_mm = gel.friction * scene.grasp.force_n / area_mm2 * gel.thickness_mm / gel.shear_modulus_n_per_mm2
    return shear_mm / sensor.marker_pitch_mm


def touched_width_mm(scene: Scene) -> float:
    """Width of the held surface within half a thickness of its crest, at most the pad's, mm."""
    width_mm, body, depth = scene.sensor.gel_width_mm, scene.object, 0.5 * scene.gel.thickness_mm
    faces = body.held_faces
    if faces is not None:
        crest = float(body.held_profile[0])
        ends = [_reach_of_faces(side, crest - depth) for side in faces]
        return min(width_mm, sum(ends) / len(ends))
    _, flat, arc_x, arc_y, slope = (float(value) for value in body.held_profile)
    beyond = depth / slope if slope > 0.0 else arc_x * math.sqrt(max(0.0, 1.0 - (1.0 - min(1.0, depth / arc_y)) ** 2))
    return min(width_mm, 2.0 * (flat + beyond))


def _reach_of_faces(lines: NDArray[np.float64], level_mm: float) -> float:
    """Width above a level of a side given by lines (height at 0, slope), the lowest of which counts."""
    x = np.linspace(-40.0, 40.0, 801)
    heights = lines[:, 0] + np.multiply.outer(x, lines[:, 1])
    return float((heights.min(axis=1) > level_mm).sum() * 0.1)
