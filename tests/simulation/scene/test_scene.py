"""Scenes refuse impossible values, naming the key."""

import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulation.scene.drawn import scene_of_tables
from simulation.scene.randomisation import randomised
from simulation.scene.scene import SceneError
from simulation.scene.worlds import load_scene, object_names

UNIT = st.floats(0.0, 1.0)


@pytest.mark.parametrize("name", object_names())
def test_every_built_in_scene_loads(name: str) -> None:
    assert load_scene(name).clearance_mm == pytest.approx(2.25, abs=0.3)


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ({"gel__thicknes_mm": 1.0}, "gel.thicknes_mm: unknown key"),
        (
            {"gel__shear_modulus_n_per_mm2": -0.1},
            "gel.shear_modulus_n_per_mm2: expected a number >= 0.005 and <= 5.0 (given: -0.1)",
        ),
        ({"blocks__gap_mm": 50.0}, "blocks.gap_mm: 50.0 must exceed object.size_x_mm 51.0"),
        ({"blocks__stiffness_n_per_mm": -5.0}, "blocks.stiffness_n_per_mm: expected a number >= 5.0 and <= 50000.0"),
        ({"gel__friction": float("nan")}, "gel.friction: expected a number >= 0.0 and <= 2.0 (given: nan)"),
        ({"object__corner_radius_mm": 40.0}, "object.corner_radius_mm: must be 0 to 25.5"),
        ({"object__held_corner_radius_mm": 40.0}, "object.held_corner_radius_mm"),
        ({"gel__crown_mm": 1.0, "gel__thickness_mm": 1.0}, "gel.crown_mm: must be 0 to 0.5"),
        ({"camera__fps": 9}, "camera.fps: expected a number >= 10 and <= 120 (given: 9)"),
    ],
)
def test_an_impossible_scene_is_refused_by_name(override: dict[str, float], named: str) -> None:
    with pytest.raises(SceneError, match=re.escape(named)):
        load_scene("rectangle", **override)


def test_an_unknown_name_gets_the_nearest_one() -> None:
    with pytest.raises(SceneError, match="did you mean 'rectangle'"):
        load_scene("rectangel")


@pytest.mark.parametrize("name", object_names())
def test_every_draw_of_every_object_can_exist(name: str) -> None:
    scene, rng = load_scene(name), np.random.default_rng(1)
    draws = [randomised(scene, rng, held_out=bool(index % 2)) for index in range(60)]
    assert len({draw.grasp.height_mm for draw in draws}) == 60


SQUARE = {"shape": "rectangle", "size_x_mm": 60.0, "size_y_mm": 60.0}


@pytest.mark.parametrize(
    "body",
    [
        {"shape": "rectangle", "size_x_mm": 60.0, "size_y_mm": 40.0, "corner_radius_mm": 20.0},
        {"shape": "rectangle", "size_x_mm": 6.1, "size_y_mm": 6.0},
        {"shape": "ellipse", "size_x_mm": 100.0, "size_y_mm": 100.0},
        {"shape": "hexagon", "size_x_mm": 110.0, "size_y_mm": 110.0, "corner_radius_mm": 10.0},
        {"shape": "polygon", "vertices_mm": [[0, 0], [60, 0], [60, 25], [30, 40], [0, 25]], "corner_radius_mm": 14.0},
        {"shape": "polygon", "vertices_mm": [[0, 0], [60, 0], [60, 109], [0, 109]], "corner_radius_mm": 9.0},
        {"shape": "rectangle", "size_x_mm": 51.0, "size_y_mm": 51.0, "corner_radius_mm": 25.0, "held_size_y_mm": 40.0},
        {**SQUARE, "held_shape": "rectangle", "held_corner_radius_mm": 30},
        {**SQUARE, "held_shape": "hexagon", "held_corner_radius_mm": 25},
    ],
    ids=lambda body: f"{body['shape']} {body.get('size_x_mm', '')}",
)
def test_every_draw_of_an_object_at_the_limits_can_exist(body: dict[str, Any]) -> None:
    scene, rng = scene_of_tables({"object": body}, "mine"), np.random.default_rng(4)
    sizes = [randomised(scene, rng, held_out=bool(index % 2)).object for index in range(60)]
    if body["shape"] in {"ellipse", "hexagon"}:
        assert all(one.size_x_mm == one.size_y_mm for one in sizes)
    if "held_shape" in body:
        assert max(one.held_corner_radius_mm for one in sizes) > body["held_corner_radius_mm"]


def test_a_held_section_is_what_its_file_says() -> None:
    body = {"shape": "rectangle", "size_x_mm": 60.0, "size_y_mm": 60.0, "corner_radius_mm": 6.0, "held_size_x_mm": 20.0}
    flat = [
        scene_of_tables({"object": {**body, **radius}}, "mine").object.held_profile[1]
        for radius in ({}, {"held_corner_radius_mm": 0.0})
    ]
    assert flat[1] - flat[0] == pytest.approx(6.0, abs=0.5), "0 is no corner, not that of the bottom"
    hexagon = {"shape": "hexagon", "size_x_mm": 60.0, "size_y_mm": 60.0, "held_size_x_mm": 40.0}
    held, whole = (scene_of_tables({"object": {**hexagon, "held_size_x_mm": x}}, "mine").object for x in (40.0, 60.0))
    assert held.held_width_mm == pytest.approx(whole.held_width_mm * 40.0 / 60.0), "it stays regular"


def test_every_draw_of_the_largest_scene_can_exist() -> None:
    largest = {
        "object.size_x_mm": 200.0,
        "object.size_y_mm": 110.0,
        "object.corner_radius_mm": 50.0,
        "blocks.gap_mm": 250.0,
        "camera.noise_grey": 30.0,
        "x_range_mm": 60.0,
    }
    scene, rng = load_scene("rectangle").varied(largest), np.random.default_rng(2)
    assert all(randomised(scene, rng, held_out=bool(index % 2)).blocks.gap_mm <= 250.0 for index in range(60))


def test_a_scenes_own_values_are_the_middle_of_what_is_drawn() -> None:
    stiff = {"gel__shear_modulus_n_per_mm2": 0.3, "gel__friction": 0.5, "grasp__force_n": 60.0, "gel__crown_mm": 0.3}
    scene, rng = (
        load_scene("rectangle", grasp__height_mm=40.0, gel__poisson_ratio=0.45, **stiff),
        np.random.default_rng(3),
    )
    draws = [randomised(scene, rng) for _ in range(400)]
    for own, drawn in (
        (0.3, [draw.gel.shear_modulus_n_per_mm2 for draw in draws]),
        (0.5, [draw.gel.friction for draw in draws]),
        (60.0, [draw.grasp.force_n for draw in draws]),
        (0.3, [draw.gel.crown_mm for draw in draws]),
        (40.0, [draw.grasp.height_mm for draw in draws]),
    ):
        assert np.mean(drawn) == pytest.approx(own, rel=0.06)
        assert 0.1 < np.ptp(drawn) / own < 1.3
    assert {draw.gel.poisson_ratio for draw in draws} == {0.45}
    default_mm = load_scene("rectangle").grasp.height_mm
    stated = [randomised(load_scene("rectangle", grasp__height_mm=default_mm), rng).grasp.height_mm for _ in range(200)]
    assert np.mean(stated) == pytest.approx(default_mm, rel=0.1), "a default that is stated counts as stated"


def test_held_out_draws_never_meet_training_draws() -> None:
    scene, rng = load_scene("circle"), np.random.default_rng(0)
    train = [randomised(scene, rng).gel.friction for _ in range(50)]
    held = [randomised(scene, rng, held_out=True).gel.friction for _ in range(50)]
    assert all(0.65 <= value <= 0.95 for value in train)
    assert not any(0.65 < value < 0.95 for value in held)


@given(friction=st.floats(0.05, 1.5), table_friction=st.floats(0.05, 1.5), mass_kg=st.floats(0.05, 10.0), share=UNIT)
def test_a_block_that_is_said_to_stay_is_held_by_its_table_under_every_press(friction, table_friction, mass_kg, share):
    blocks = {"friction": friction, "table_friction": table_friction, "mass_kg": mass_kg, "free": True}
    scene = load_scene("rectangle", **{f"blocks__{key}": value for key, value in blocks.items()})
    weight_n, most_n = 9.81 * mass_kg, 2.0 * scene.gel.friction * scene.grasp.force_n + 9.81 * scene.object.mass_kg
    press_n = share * most_n
    if scene.neighbours_stay:
        assert friction * press_n <= table_friction * (press_n + weight_n) + 1e-9
    else:
        assert friction * most_n > table_friction * (most_n + weight_n)
    assert load_scene(
        "rectangle", **{f"blocks__{key}": value for key, value in blocks.items()} | {"blocks__free": False}
    ).neighbours_stay
