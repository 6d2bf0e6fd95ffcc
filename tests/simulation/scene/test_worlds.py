"""Worlds and objects in files: every world with every object; impossible values are refused by name."""

import re
from pathlib import Path

import numpy as np
import pytest

from simulation.scene import rubber
from simulation.scene.effects import active_effects
from simulation.scene.scene import SceneError
from simulation.scene.worlds import World, files_in, load_scene, load_world, object_names, training_objects

BOX = '[object]\nshape = "rectangle"\nsize_x_mm = 60.0\nsize_y_mm = 90.0\n'
TIN = '[object]\nshape = "ellipse"\nsize_x_mm = 44.0\nsize_y_mm = 44.0\nmass_kg = 0.08\n'
PENTAGON = """
[object]
shape = "polygon"
vertices_mm = [[30.0, -22.0], [30.0, 15.0], [0.0, 38.0], [-30.0, 15.0], [-30.0, -22.0]]
"""
HEXAGON = '[object]\nshape = "hexagon"\nsize_x_mm = 60.0\n'
SLIPPERY = """
[gel]
tier = "layer"
friction = 0.55

[grasp]
force_n = 15.0

[blocks]
friction = 0.45
free = false

[camera]
fps = 60.0

[motion]
descent_speed_mm_s = 20.0

[world]
told_gap_error_mm = 2.0
told_height_error_mm = 5.0
stop_lag_s = 0.06
"""


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / f"{name}.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("name", [*object_names(), "box", "tin", "pentagon"])
def test_every_world_can_be_played_with_every_object(tmp_path: Path, name: str) -> None:
    new = {"box": BOX, "tin": TIN, "pentagon": PENTAGON}
    alone = load_scene(write(tmp_path, name, new[name]) if name in new else name)
    joined = load_world(write(tmp_path, "slippery", SLIPPERY)).around(alone)
    assert (joined.gel.tier, joined.gel.friction, joined.grasp.force_n) == ("layer", 0.55, 15.0)
    assert (joined.blocks.friction, joined.blocks.free, joined.blocks.gap_mm) == (0.45, False, alone.blocks.gap_mm)
    assert (joined.camera.fps, joined.speed_mm_s) == (60, 20.0)
    assert joined.object == alone.object
    assert World().around(alone) == alone


@pytest.mark.parametrize(("text", "gap_mm", "x_mm"), [(BOX, 64.0, 15.0), (TIN, 48.0, 13.2), (PENTAGON, 64.0, 15.0)])
def test_gap_and_start_follow_from_the_width_where_the_file_leaves_them_out(tmp_path, text, gap_mm, x_mm) -> None:
    scene = load_scene(write(tmp_path, "new", text))
    assert (scene.blocks.gap_mm, scene.x_range_mm, scene.theta_range_deg) == pytest.approx((gap_mm, x_mm, 15.0))
    stated = "[blocks]\ngap_mm = 70.0\n[start]\nx_range_mm = 4.0\ntheta_range_deg = 3.0\n"
    scene = load_scene(write(tmp_path, "new", text + stated))
    assert (scene.blocks.gap_mm, scene.x_range_mm, scene.theta_range_deg) == (70.0, 4.0, 3.0)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[gell]\n", "gell: unknown table; did you mean 'gel'?"),
        ("gel = 1\n", "gel: expected a table of keys (given: 1)"),
        ("[gel]\nfricton = 0.5\n", "gel.fricton: unknown key; did you mean 'friction'? (given: 0.5)"),
        ("[gel]\nfriction = 5.0\n", "gel.friction: expected a number >= 0.0 and <= 2.0 (given: 5.0)"),
        ("[camera]\nfps = 5\n", "camera.fps: expected a number >= 10 and <= 120"),
        ("[blocks]\ngap_mm = 60.0\n", "blocks.gap_mm: the gap stands in the object's file"),
        ("[motion]\ndescent_speed_mm_s = 0.4\n", "motion.descent_speed_mm_s: expected a number >= 0.5 and <= 200.0"),
        ("[blocks]\nmass_kg = 1e-4\n", "blocks.mass_kg: expected a number >= 0.001 and <= 20.0"),
        ("[world]\nstop_lag_s = 3.0\n", "world.stop_lag_s: expected a number >= 0.0 and <= 0.5"),
        ("[gel]\npoisson_ratio = 0.5\n", "gel.poisson_ratio: expected a number >= 0.0 and <= 0.4999"),
        ("[gel]\nmargin_mm = [0.5]\n", "gel.margin_mm"),
        ("[gel]\nmargin_mm = [0.5, -1.0]\n", "gel.margin_mm.1: Input should be greater than or equal to 0"),
        ("[gel]\nrelaxation_share = 1.2\n", "gel.relaxation_share: expected a number >= 0.0 and <= 1.0"),
        ("[grasp]\nfinger_stiffness_n_per_mm = -1\n", "grasp.finger_stiffness_n_per_mm: expected a number >= 0.0"),
        ("[camera]\nlatency_ms = 700\n", "camera.latency_ms: expected a number >= 0.0 and <= 500.0"),
        ("[world]\nx_sign = 2\n", "world.x_sign: Input should be 1 or -1 (given: 2)"),
        ("[world]\nx_sign = true\n", "world.x_sign: Input should be 1 or -1"),
        ("[world]\nyaw_sign = [1]\n", "world.yaw_sign: Input should be 1 or -1 (given: [1])"),
        ("[world]\ntcp_offset_mm = 2.0\n", "world.tcp_offset_mm: expected a list of values in brackets (given: 2.0)"),
        ("[world]\nmirrored = [1, 0]\n", "world.mirrored.0: Input should be a valid boolean (given: 1)"),
        ("[gel]\nfriction = true\n", "gel.friction: expected a number >= 0.0 and <= 2.0 (given: True)"),
        ("[gel]\nfriction = '0.5'\n", "gel.friction: expected a number >= 0.0 and <= 2.0 (given: '0.5')"),
        ("[camera]\nfps = '30'\n", "camera.fps: expected a number >= 10 and <= 120 (given: '30')"),
        ("[blocks]\nfree = 'no'\n", "blocks.free: Input should be a valid boolean (given: 'no')"),
        ("[world]\ncamera_scale = [1.0, 3.0]\n", "world.camera_scale.1: Input should be less than or equal to 1.25"),
        ("[gel\n", "not valid TOML"),
    ],
)
def test_a_world_that_cannot_be_is_refused_by_file_and_key(tmp_path: Path, text: str, named: str) -> None:
    path = write(tmp_path, "odd", text)
    with pytest.raises(SceneError, match=f"{re.escape(str(path))}.*{re.escape(named)}"):
        load_world(path)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (BOX.replace("rectangle", "rectangel"), "object.shape: Input should be"),
        (BOX.replace("size_y_mm", "sizey_mm"), "object.sizey_mm: unknown key; did you mean 'size_y_mm'?"),
        (BOX + "colour = 1\n", "object.colour: unknown key"),
        (BOX + "vertices_mm = [[0, 0], [9, 0], [9, 9]]\n", "object.vertices_mm: expected with shape = 'polygon'"),
        ('[object]\nshape = "polygon"\n', "object: vertices_mm: missing, expected the corners [x, y] of a polygon"),
        (BOX.replace("60.0", "5.5"), "object.size_x_mm: the held section must be at least 6 mm wide"),
        (BOX + "held_size_x_mm = 5.5\n", "object.held_size_x_mm: the held section must be at least 6 mm wide"),
        (PENTAGON.replace("[0.0, 38.0]", "[0.0, 10.0]"), "object.vertices_mm: expected corners of a convex polygon"),
        (PENTAGON.replace("[0.0, 38.0]", "[0.0]"), "object.vertices_mm"),
        (PENTAGON + "corner_radius_mm = 40.0\n", "object.corner_radius_mm: two corners' arcs do not fit on the edge"),
        (
            PENTAGON + "size_y_mm = 80.0\n",
            "object.size_y_mm: vertices_mm span 60; expected no other size (given: 80.0)",
        ),
        (PENTAGON + "size_x_mm = 'wide'\n", "object.size_x_mm: vertices_mm span 60; expected no other size"),
        (PENTAGON + "size_x_mm = nan\n", "object.size_x_mm: vertices_mm span 60; expected no other size"),
        (PENTAGON + "held_size_x_mm = 30.0\n", "object.held_size_x_mm: expected with held_shape"),
        (HEXAGON + "size_y_mm = 20.0\ncorner_radius_mm = 10.0\n", "object.corner_radius_mm: two corners' arcs do not"),
        (TIN + "corner_radius_mm = 1.0\n", "object.corner_radius_mm: an ellipse has none"),
        (
            BOX.replace("rectangle", "hexagon") + "corner_radius_mm = 26.0\n",
            "object.corner_radius_mm: must be below 25.8",
        ),
        (BOX + "[start]\nx_range = 3.0\n", "start.x_range: unknown key; did you mean 'x_range_mm'?"),
        (BOX + "[start]\nx_range_mm = -3.0\n", "start.x_range_mm: expected a number > 0.0 and <= 60.0"),
        (BOX + "[motion]\nspeed = 3.0\n", "motion.speed: unknown key; allowed: descent_speed_mm_s"),
        ("start = 5\n" + BOX, "start: expected a table of keys"),
        (BOX + "[blocks]\ngap_mm = 60.0\n", "blocks.gap_mm: 60.0 must exceed object.size_x_mm 60.0"),
        ('object = "box"\n', "object: expected a table of keys"),
        ("", "object: missing, expected a table of keys"),
        (BOX.replace('shape = "rectangle"', ""), "object.shape: missing, expected one of rectangle, ellipse, hexagon"),
        (BOX + "[world]\nstop_lag_s = 0.1\n", "world: this table stands in a world's file, not in the object's"),
    ],
)
def test_an_object_that_cannot_be_is_refused_by_file_and_key(tmp_path: Path, text: str, named: str) -> None:
    path = write(tmp_path, "odd", text)
    with pytest.raises(SceneError, match=f"{re.escape(str(path))}.*{re.escape(named)}"):
        load_scene(path)


def test_a_world_that_is_not_there_is_named_in_words(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=f"^No such file or directory: {re.escape(str(tmp_path / 'none'))}$"):
        load_world(tmp_path / "none")


@pytest.mark.parametrize(
    ("world", "named"),
    [
        ("[world]\ntold_gap_error_mm = -20.0\n", "world.told_gap_error_mm: leaves 4 mm; at least 5"),
        ("[world]\ntold_height_error_mm = -40.0\n", "world.told_height_error_mm: leaves -10 mm; at least 1"),
        ("[gel]\nthickness_mm = 0.3\ncrown_mm = 0.2\n", "gel.crown_mm: must be 0 to 0.15"),
        ("[blocks]\nheight_mm = 25.0\ninsertion_depth_mm = 21.0\n", "blocks.insertion_depth_mm: must be at most 20,"),
        ("[camera]\nfps = 120\nexposure_ms = 9.0\n", "camera.exposure_ms: 9 is longer than a frame's 8.33333"),
        ("[camera]\nfps = 60\nreadout_ms = 33.0\n", "camera.readout_ms: 33 is longer than a frame's 16.6667"),
    ],
)
def test_a_world_and_an_object_that_do_not_fit_are_both_named(tmp_path: Path, world: str, named: str) -> None:
    small = BOX.replace("60.0", "20.0")
    with pytest.raises(SceneError, match=f"world odd, object small.*{re.escape(named)}"):
        load_world(write(tmp_path, "odd", world)).around(load_scene(write(tmp_path, "small", small)))


def test_a_hexagon_has_the_sizes_of_its_file_and_is_regular_where_they_are_equal(tmp_path: Path) -> None:
    for size_y_mm, high_mm in ((60.0, 30.0 * 3.0**0.5), (40.0, 40.0)):
        body = load_scene(write(tmp_path, "hexagon", f"{HEXAGON}size_y_mm = {size_y_mm}\n")).object
        assert np.ptp(body.footprint_mm, axis=0) == pytest.approx([60.0, high_mm])
        crest_mm, flat_mm, _, _, slope = body.held_profile
        assert (crest_mm, flat_mm) == pytest.approx((0.5 * high_mm, 15.0))
        assert crest_mm / slope == pytest.approx(15.0), "the sides meet at the corners on x"
        rounded = load_scene(write(tmp_path, "soft", f"{HEXAGON}size_y_mm = {size_y_mm}\ncorner_radius_mm = 2.0\n"))
        assert rounded.object.held_width_mm == pytest.approx(high_mm)


@pytest.mark.parametrize(("text", "radius_mm"), [(BOX + "corner_radius_mm = 4.0\n", 4.0), (TIN, 0.0)])
def test_held_sizes_without_a_shape_are_those_of_the_objects_own(tmp_path: Path, text: str, radius_mm: float) -> None:
    body = load_scene(write(tmp_path, "held", text + "held_size_y_mm = 30.0\n")).object
    shape = f'held_shape = "{body.shape}"\nheld_corner_radius_mm = {radius_mm}\n'
    stated = load_scene(write(tmp_path, "stated", text + shape + "held_size_y_mm = 30.0\n")).object
    assert body.held_profile[0] == 15.0
    assert body.held_profile.tolist() == stated.held_profile.tolist()
    assert body.footprint_mm.tolist() == load_scene(write(tmp_path, "whole", text)).object.footprint_mm.tolist()


def test_blocks_are_free_unless_the_object_or_the_world_fixes_them(tmp_path: Path) -> None:
    from simulation.closed_loop.job import Job, job_in

    fixed = write(tmp_path, "fixed", BOX + "[blocks]\nfree = false\n")
    for world, scene, free in ((World(), "circle", True), (World(), str(fixed), False)):
        assert Job(**job_in(world, scene, 0, (8.0, 5.0), 1)).build_scene().blocks.free is free
    for free in (True, False):
        world = World("w", {"blocks.free": free})
        assert Job(**job_in(world, str(fixed), 0, (8.0, 5.0), 1)).build_scene().blocks.free is free


def test_an_object_may_state_any_table_of_a_world_and_the_world_takes_precedence(tmp_path: Path) -> None:
    tables = SLIPPERY[: SLIPPERY.index("[world]")]
    scene = load_scene(write(tmp_path, "box", BOX + tables))
    assert (scene.gel.friction, scene.grasp.force_n, scene.camera.fps, scene.speed_mm_s) == (0.55, 15.0, 60, 20.0)
    slow = load_world(write(tmp_path, "slow", "[motion]\ndescent_speed_mm_s = 4.0\n"))
    assert slow.around(scene).speed_mm_s == 4.0


def test_every_key_of_the_format_is_read(tmp_path: Path) -> None:
    from simulation.scene import drawn

    written = drawn.draw_worlds(3, 5)
    assert written == drawn.draw_worlds(3, 5)
    for number, tables in enumerate(written):
        path = write(tmp_path, f"drawn{number}", drawn.toml(tables, "drawn"))
        scene = load_world(path).around(load_scene("rectangle"))
        assert scene.gel.margin_mm == tuple(tables["gel"]["margin_mm"])
        assert scene.fps == tables["camera"]["fps"]
        assert 0.14 < rubber.shear_reach_pitches(scene) < 3.1


def test_drawn_worlds_spread_every_quantity_over_its_range() -> None:
    from simulation.scene import drawn

    worlds = drawn.draw_worlds(50, 1)
    for table, key, low, high in (("gel", "poisson_ratio", 0.25, 0.495), ("world", "stop_lag_s", 0.01, 0.08)):
        places = sorted(int(50 * (world[table][key] - low) / (high - low)) for world in worlds)
        assert places == list(range(50))
    assert len(drawn.draw_objects(8, 1)) == 8


def test_shear_reach_is_what_friction_can_hold_over_what_shear_costs() -> None:
    flat = load_scene("rectangle", gel__friction=0.8, gel__thickness_mm=2.5, grasp__force_n=20.0)
    assert rubber.shear_reach_pitches(flat) == pytest.approx(0.8 * 20.0 / (22.05 * 21.0) * 2.5 / 0.1 / 1.05)
    assert rubber.shear_reach_pitches(load_scene("circle")) > rubber.shear_reach_pitches(flat)


def test_folders_files_and_names_are_listed_once_each(tmp_path: Path) -> None:
    box, tin = str(write(tmp_path, "box", BOX)), str(write(tmp_path, "tin", TIN))
    (tmp_path / "._box.toml").write_bytes(b"\x00\x05\x16\x07")  # macOS writes such files beside others
    assert files_in(["circle", tmp_path], object_names()) == ("circle", box, tin)
    (tmp_path / "empty").mkdir()
    with pytest.raises(SceneError, match="no TOML file in this folder"):
        files_in([tmp_path / "empty"])
    with pytest.raises(SceneError, match="box: given more than once"):
        files_in([tmp_path, box])


def test_seeds_follow_the_stated_order_or_the_file_and_never_the_list(tmp_path: Path) -> None:
    assert [load_scene(name).number for name in object_names()] == list(range(len(object_names())))
    assert training_objects() == ("rectangle", "circle", "ellipse", "hexagon")
    box = write(tmp_path, "box", BOX)
    assert load_scene(box).number == load_scene(box).number != load_scene(write(tmp_path, "tin", TIN)).number


def test_an_objects_own_texture_stands_in_its_file(tmp_path: Path) -> None:
    from simulation.optics.appearance import Appearance

    coarse = BOX + 'texture = "ribbed"\ntexture_period_mm = 1.4\ntexture_gain = 0.2\n'
    look = Appearance.draw(load_scene(write(tmp_path, "box", coarse)), "left", 0)
    assert (look.object_texture, look.object_texture_gain) == ("ribs", 0.2)
    assert look.object_texture_period_px == pytest.approx(20.0)
    for stated, gain in (("texture_gain = 0.2", 0.2), ('texture = "ribbed"\ntexture_gain = 0.0', 0.0), ("", 0.0)):
        own = load_scene(write(tmp_path, "own", BOX + stated))
        assert Appearance.draw(own, "left", 0).object_texture_gain == gain
        assert active_effects(own).object_texture == (gain > 0.0), "what a scene states is simulated"
