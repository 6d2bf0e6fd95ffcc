"""Choices of settings are played fairly, keep every bound of the client, and are chosen by what they reached."""

import tomllib
from pathlib import Path

import pytest

from robot_client.cli.insert import make_plan
from robot_client.insertion.events import Begin
from robot_client.insertion.machine import Phase, State, step
from robot_client.settings import load_settings
from service.contract.shipped import released_models
from simulation.cell.config import client_config
from simulation.closed_loop.job import Job
from simulation.closed_loop.play import insert, models_of
from simulation.scene.worlds import World, load_objects
from simulation.studies.pace.choose import Wanted, choose, settings_toml
from simulation.studies.pace.points import POINTS, TODAY, client, tasks
from simulation.studies.pace.report import front

FACTS = {
    "egm_guide_port": 6510,
    "rapid": {},
    "rws_url": "http://127.0.0.1:80",
    "gripper": "127.0.0.1:1000",
    "object": "rectangle",
    "approach": {"z_mm": 35.0},
    "gap_width_mm": 56.0,
    "expected_depth_mm": 25.0,
    "creep_allowance_mm": 4.0,
    "home": {"x_mm": 0.0, "y_mm": 0.0, "z_mm": 60.0, "yaw_deg": 0.0},
}


def point(name="a", seconds=4.0, inserted=48, wrong=0, force=20.0):
    return {
        "name": name,
        "seconds_a_box": [seconds, seconds - 0.2, seconds + 0.2],
        "inserted": inserted,
        "claimed_wrongly": wrong,
        "force_n": {"95": force, "largest": force + 5.0},
        "client": client(15.0, fast_mm_s=25.0),
        "fps": 60.0,
        "controller": "belief",
    }


def test_every_choice_begins_from_the_same_starts_in_the_same_worlds():
    todo = tasks(POINTS, [World()], load_objects(["circle", "can"]), 2, 5, Path("m"))
    same = ("scene", "index", "x_mm", "theta_deg", "seed", "unstated")
    for place in range(0, len(todo), len(POINTS)):
        mine = [{key: task.job[key] for key in same} for task in todo[place : place + len(POINTS)]]
        assert all(job == mine[0] for job in mine)
    assert len({task.key for task in todo}) == len(todo)


@pytest.mark.parametrize("chosen", POINTS, ids=lambda point: point.name)
def test_the_client_accepts_every_choice_with_all_its_bounds(chosen):
    plan = make_plan(load_settings(None, dict(chosen.client)), 3.0, 2.0, "t", None)
    state, _ = step(State(plan), Begin(at_s=0.0, pose=plan.approach))
    assert state.phase is Phase.GREETING


def test_the_front_holds_what_no_other_beats():
    points = [point("quick"), point("beaten", 5.0), point("gentle", 6.0, force=10.0), point("safe", 7.0, 49)]
    assert front(points) == {"quick", "gentle", "safe"}


def test_the_quickest_that_keeps_all_three_is_chosen_and_else_the_nearest():
    data = {"insertions": 50, "points": [point("slow", 6.0, 50), point("quick", 4.0, 45), point("liar", 2.0, 50, 1)]}
    assert [choose(data, Wanted(*asked))[0]["name"] for asked in ((7.0, 0.99, 30.0), (7.0, 0.9, 30.0))] == [
        "slow",
        "quick",
    ]
    nearest, kept = choose(data, Wanted(4.5, 0.99, 30.0))
    assert (nearest["name"], kept) == ("slow", False)
    with pytest.raises(ValueError, match="expected seconds"):
        choose(data, Wanted(-1.0, 0.9, 30.0))


def test_settings_that_were_chosen_are_a_configuration_of_the_client_and_lower_the_approach(tmp_path):
    chosen = tomllib.loads(settings_toml(point(), 48))
    file = tmp_path / "cell.toml"
    file.write_text(client_config(FACTS, "http://127.0.0.1:1", None, chosen=chosen))
    settings = load_settings(file)
    assert (settings.pace.fast_mm_s, settings.ramps.descend.speed_mm_s) == (25.0, 15.0)
    assert (settings.task.approach_z_mm, settings.task.expected_depth_mm) == (33.0, 23.0)
    assert settings.task.grasp_height_mm == 30.0


def test_seconds_in_lock_step_add_up_and_a_fast_client_inserts_sooner():
    models = models_of(released_models())
    play = {}
    for chosen in (POINTS[0], POINTS[5]):
        job = Job(
            "circle", 0, 0.1, 0.1, 5, "belief", "fields", changes={"camera.fps": chosen.fps}, client=chosen.client
        )
        play[chosen.name] = insert(job, models)
    first, fast = play[TODAY], play[POINTS[5].name]
    assert first["inserted"]
    assert fast["inserted"]
    assert first["attempts"] == fast["attempts"] == 1
    assert first["seconds"]["guarded descent"] == pytest.approx(2.7, abs=0.15)  # 25 mm at 10 mm/s, and a ramp
    assert first["seconds"]["fast descent"] == 0.0
    assert 0.4 < fast["seconds"]["fast descent"] < 1.0
    assert sum(fast["seconds"].values()) < 0.65 * sum(first["seconds"].values())
