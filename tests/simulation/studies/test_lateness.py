"""A commissioning tells how late a simulated cell is, whose lateness is known."""

import pytest

from robot_client.session.commission.lateness import LEAST_OPEN_S
from service.contract.shipped import released_models
from simulation.cli.drawn_worlds import drawn_worlds_of
from simulation.closed_loop.play import Insertion
from simulation.scene import drawn
from simulation.scene.state import PhysicsError
from simulation.scene.worlds import World, load_objects, load_scene
from simulation.studies.lateness import errors_ms, lateness, timed

TABLES = drawn.draw_worlds(3, 77)


@pytest.mark.parametrize(("latency_ms", "stop_lag_s"), [(0.0, 0.01), (40.0, 0.05), (100.0, 0.08)])
def test_presses_bound_the_latency_and_the_stop_lag_together(latency_ms, stop_lag_s):
    tables = {name: dict(table) for name, table in TABLES[0].items()}
    tables["gel"]["tier"] = "bristle"
    tables["camera"] |= {"latency_ms": latency_ms, "fps": 60.0}
    tables["world"]["stop_lag_s"] = stop_lag_s
    world = drawn.world(tables, "late")
    world.around(load_scene("rectangle"))
    row = timed(world, "rectangle", 5, released_models())
    assert row["true_late_s"] == pytest.approx(1e-3 * latency_ms + stop_lag_s)
    off_s = row["late_s"] - row["true_late_s"]
    assert 0.0 < off_s < LEAST_OPEN_S + 0.01, "it is never taken for shorter than it is"
    assert 0.0 < row["robot_s"] < 60.0


def test_an_object_that_turns_in_the_hand_is_regrasped_and_pressed_on_as_on_a_cell():
    turning = drawn_worlds_of(200, 109, 0.1)[117]
    row = timed(turning, "rectangle", 5, released_models())
    assert 0.0 <= row["late_s"] - row["true_late_s"] < 0.06
    assert 45.0 < row["robot_s"] < 80.0, "with a second way to the fixture"


def test_a_grasp_that_has_no_equilibrium_leaves_the_lateness_unknown(monkeypatch):
    """The others go on."""

    def unsettled(*_):
        raise PhysicsError("a grasp", "pads unsettled")

    monkeypatch.setattr(Insertion, "take_afresh", unsettled)
    turning = drawn_worlds_of(200, 109, 0.1)[117]
    row = timed(turning, "rectangle", 5, released_models())
    assert row["late_s"] is None
    assert row["robot_s"] > 0.0


def test_the_latency_that_an_objects_file_states_is_true_as_well(tmp_path):
    file = tmp_path / "box.toml"
    file.write_text('[object]\nshape = "rectangle"\nsize_x_mm = 60.0\nsize_y_mm = 60.0\n[camera]\nlatency_ms = 80.0\n')
    row = timed(World(), str(file), 5, released_models())
    assert row["true_late_s"] == pytest.approx(0.08 + World().unstated.stop_lag_s)
    assert row["late_s"] is None or row["late_s"] > row["true_late_s"]


def test_each_world_is_timed_and_errors_are_counted_where_it_was_measured():
    worlds = [drawn.world(tables, str(number)) for number, tables in enumerate(TABLES[:2])]
    for world in worlds:
        world.changes["gel.tier"] = "bristle"
    rows = lateness(worlds, load_objects(["circle", "rectangle"]), 5, released_models(), 1)
    assert [row["world"] for row in rows] == ["0", "1"]
    off_ms = errors_ms([*rows, {"late_s": None, "true_late_s": 0.1}])
    assert off_ms == [1e3 * (row["late_s"] - row["true_late_s"]) for row in rows if row["late_s"] is not None]
