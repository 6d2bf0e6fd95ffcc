"""Probes in lock step that are stored as a cell's are."""

import json

import pytest

from service.contract.shipped import released_models
from simulation.closed_loop.job import job_in
from simulation.scene import drawn
from simulation.studies.episodes import Episode, play
from simulation.studies.pace.points import client, with_care
from simulation.studies.wiring import BEFORE_SIGNS

HEXAGON = """
[object]
shape = "hexagon"
size_x_mm = 30.2
size_y_mm = 30.2
mass_kg = 0.111
"""


def test_a_probe_whose_object_hangs_askew_is_repeated_in_a_new_grasp_and_only_that_is_kept(tmp_path):
    """In this grasp the fixture handed it over so far askew that the service refuses to press it."""
    tables = drawn.draw_worlds(12, 105)[4]
    tables["gel"]["tier"] = "bristle"
    world = drawn.world(tables, "soft gel")
    hexagon = tmp_path / "hexagon.toml"
    hexagon.write_text(HEXAGON)
    given = with_care(client(), world, str(hexagon), None)
    job = job_in(world, str(hexagon), 3, (1.2, -6.94), 3844133872, client=given, **BEFORE_SIGNS)
    row = play(Episode(tmp_path / "probe", released_models(), job))
    assert (row["reason"], row["grasps"], row["attempts"]) == ("", 2, 1)
    assert row["robot_s"] > 25.0, "twice to the fixture"
    assert [path.name for path in tmp_path.glob("probe/*.npz")] == ["attempt_01.npz"]


def test_a_probe_in_which_the_arm_paused_is_repeated_in_a_new_grasp_and_only_that_is_kept(tmp_path):
    """Cameras that lose a fifth of their frames: the lease ends in the press."""
    tables = drawn.draw_worlds(12, 105)[4]
    tables["gel"]["tier"] = "bristle"
    tables["camera"] |= {"fps": 16.0, "dropped_share": 0.2}
    world = drawn.world(tables, "slow cameras")
    given = with_care(client(), world, "rectangle", None)
    job = job_in(world, "rectangle", 0, (8.0, 8.0), 5, client=given, **BEFORE_SIGNS)
    row = play(Episode(tmp_path / "probe", released_models(), job))
    assert (row["reason"], row["grasps"], len(row["trials"])) == ("", 2, 1)
    assert row["trials"][0]["decision"]["reason"] != "stale"
    assert row["robot_s"] > 25.0, "twice to the fixture"
    assert [path.name for path in tmp_path.glob("probe/*.npz")] == ["attempt_01.npz"]


@pytest.mark.parametrize(("index", "start", "kept_n"), [(2, (7.0, 4.0), 1), (3, (6.0, 2.0), 0)])
def test_an_insertion_with_regrasps_teaches_what_its_last_grasp_shows_as_on_a_cell(tmp_path, index, start, kept_n):
    """On a cell the grasps before it are recordings of their own that failed, and their errors are not known."""
    tables = drawn.draw_worlds(12, 105)[4]
    tables["gel"]["tier"] = "bristle"
    world = drawn.world(tables, "soft gel")
    given = with_care(client(straightens=False), world, "rectangle", None)
    row = play(
        Episode(
            tmp_path / "work", released_models(), job_in(world, "rectangle", index, start, 50 + index, client=given)
        )
    )
    assert row["inserted"]
    assert row["grasps"] > 1
    assert len(row["trials"]) > kept_n
    assert len([*tmp_path.glob("work/*.npz")]) == kept_n
    assert json.loads((tmp_path / "work" / "summary.json").read_text())["continues"]
