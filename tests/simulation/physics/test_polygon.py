"""A polygon presses, is held and enters the gap as its corners say."""

import math

import numpy as np
import pytest

from simulation.data.probe import run_probe
from simulation.physics.quasistatic import QuasiStaticCell
from simulation.scene.randomisation import randomised
from simulation.scene.scene import Scene
from simulation.scene.shapes import GRIP_HALF_MM, centred, faces, is_convex
from simulation.scene.worlds import load_scene

PENTAGON = ((30.0, -22.0), (30.0, 15.0), (0.0, 38.0), (-30.0, 15.0), (-30.0, -22.0))
SKEWED = ((24.0, -25.0), (28.0, 20.0), (5.0, 33.0), (-26.0, 24.0), (-28.0, -20.0))
TAPERED = ((27.0, -25.0), (14.0, 25.0), (-14.0, 25.0), (-27.0, -25.0))
STILL = {"grasp.pre_tilt_spread_deg": 0.0, "grasp.pre_yaw_spread_deg": 0.0}


def polygon(like: str, vertices: object, **changes: object) -> Scene:
    body = {"object.shape": "polygon", "object.vertices_mm": vertices, "object.corner_radius_mm": 0.0}
    return load_scene(like).varied(body | STILL | changes)


@pytest.mark.parametrize("name", ["rectangle", "hexagon"])
def test_a_polygon_with_the_corners_of_a_known_shape_plays_like_it(name: str) -> None:
    known = load_scene(name).varied(STILL)
    drawn, expected = (
        run_probe(scene, 8.0, 5.0, seed=3) for scene in (polygon(name, known.object.footprint_mm.tolist()), known)
    )
    assert drawn.outcome == expected.outcome == "blocked"
    assert drawn.wrench == pytest.approx(expected.wrench, abs=1e-3)
    assert drawn.gel == pytest.approx(expected.gel, abs=1e-3)


def test_a_pentagon_is_held_at_its_roof_and_its_flat_and_stops_on_the_block() -> None:
    scene = polygon("rectangle", PENTAGON, **{"blocks.gap_mm": 64.0})
    probe = run_probe(scene, 8.0, 5.0, seed=3)
    assert probe.outcome == "blocked"
    roof, flat = probe.gel[0, 0, ..., 2], probe.gel[0, 1, ..., 2]
    assert {(roof > 0).mean() < 0.7, (flat > 0).mean() < 0.7} == {True, False}
    assert run_probe(scene, 0.0, 0.0, seed=3).outcome == "inserted"


def test_a_turned_polygon_enters_where_both_of_its_sides_do() -> None:
    """Turned by 8 deg the taper reaches 30.2 mm to one side and 23.3 mm to the other; 29 mm are free."""
    scene = polygon("rectangle", TAPERED, **{"blocks.gap_mm": 58.0})
    cell = QuasiStaticCell(scene)
    for x_mm, enters in ((-4.0, False), (0.5, False), (3.0, True), (7.0, False)):
        for side in (1.0, -1.0):
            cell.regrasp(side * x_mm, side * -8.0)
            x, y, z, yaw = cell.pose
            assert cell.move_to(x, y, z - 5.6, math.degrees(yaw)).in_contact != enters
            assert scene.fits(side * x_mm, side * -8.0) == enters


def test_a_mirrored_polygon_at_the_mirrored_error_feels_the_mirrored_force() -> None:
    mirrored = [(-x, y) for x, y in reversed(SKEWED)]
    wrenches = [
        run_probe(polygon("rectangle", vertices, **{"blocks.gap_mm": 62.0}), side * 8.0, side * 5.0, seed=3).wrench[-1]
        for vertices, side in ((SKEWED, 1), (mirrored, -1))
    ]
    mirror = np.array([-1.0, 1.0, 1.0, 1.0, -1.0, -1.0])
    assert wrenches[0] * mirror == pytest.approx(wrenches[1], rel=0.02, abs=2.0)


@pytest.mark.parametrize("vertices", [PENTAGON, SKEWED])
def test_fingers_touch_both_sides_of_a_polygon_equally_far_out(vertices: tuple[tuple[float, float], ...]) -> None:
    polygon_mm, x = centred(vertices), np.linspace(-GRIP_HALF_MM, GRIP_HALF_MM, 401)
    assert polygon_mm[:, 0].max() == pytest.approx(-polygon_mm[:, 0].min())
    tops = [(side[:, :1] + side[:, 1:] * x).min(axis=0) for side in faces(vertices)]
    assert tops[0].max() == pytest.approx(tops[1].max(), abs=0.1)
    for corner, height in polygon_mm:
        lines = [(side[:, 0] + side[:, 1] * corner).min() for side in faces(vertices)]
        assert min(abs(lines[0] - height), abs(lines[1] + height)) < 1e-9


def test_a_draw_scales_a_polygon_with_its_sizes() -> None:
    scene, rng = polygon("rectangle", PENTAGON, **{"blocks.gap_mm": 64.0}), np.random.default_rng(1)
    for drawn in (randomised(scene, rng, held_out=bool(k % 2)) for k in range(20)):
        spans = np.ptp(np.asarray(drawn.object.vertices_mm), axis=0)
        assert spans == pytest.approx((drawn.object.size_x_mm, drawn.object.size_y_mm))
        assert drawn.clearance_mm > 0.0


def test_only_convex_polygons_once_around_are_convex() -> None:
    star = [(math.cos(0.8 * math.pi * k), math.sin(0.8 * math.pi * k)) for k in range(5)]
    assert is_convex(PENTAGON)
    assert not is_convex(PENTAGON[::-1])
    assert not is_convex([(0, 0), (2, 0), (1, 0.5), (1, 2)])
    assert not is_convex(star)
    assert not is_convex([(0, 0), (1, 0), (2, 0), (1, 2)])


def test_a_roof_and_a_flat_bear_the_force_of_the_grip_alike() -> None:
    cell = QuasiStaticCell(polygon("rectangle", PENTAGON, **{"blocks.gap_mm": 64.0}), 3)
    assert cell._grips() == pytest.approx(cell.scene.grasp.force_n, rel=0.01)
