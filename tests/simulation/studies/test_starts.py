"""Probes in lock step: one grasp serves several starts, and each answer is stored with its own."""

import json

import pytest

from robot_client.insertion.events import FromService
from robot_client.insertion.state import REFUSED
from service.contract import Sensor, wire
from service.contract.shipped import released_models
from simulation.closed_loop.job import job_in
from simulation.closed_loop.play import Insertion
from simulation.scene import drawn
from simulation.scene.worlds import World
from simulation.studies import episodes
from simulation.studies.episodes import Episode, play
from simulation.studies.pace.points import client, with_care
from training.data.episodes import read_episodes

STARTS = [(8.0, 6.0), (-9.0, 4.0), (6.0, -7.0), (-5.0, -9.0)]


def probed(folder, world=None, **job):
    world = world or World("cell")
    given = with_care(client(), world, "rectangle", None)
    asked = job_in(world, "rectangle", 0, STARTS[0], 3, purpose="probe", starts=STARTS[1:], client=given, **job)
    return play(Episode(folder, released_models(), asked))


@pytest.mark.parametrize("refused_at", [None, 1, 3])
def test_each_start_is_probed_and_a_grasp_that_turned_is_followed_by_another(tmp_path, monkeypatch, refused_at):
    arms, plain = [], Insertion._hear

    def hear(insertion, messages):
        for message in messages:
            if isinstance(message, wire.Armed):
                arms.append(message.attempt)
                if len(arms) == refused_at:
                    named = {"insertion_id": message.insertion_id, "attempt": message.attempt}
                    messages = [wire.Refused(**named, reason="turned_in_hand", detail="it is tilted")]
        plain(insertion, messages)

    monkeypatch.setattr(Insertion, "_hear", hear)
    row = probed(tmp_path / "cell" / "00000")
    read = read_episodes(tmp_path / "cell", Sensor.load())
    assert read.error.tolist() == [list(start) for start in STARTS]
    assert set(read.groups.tolist()) == {"00000"}
    assert row["grasps"] == (1 if refused_at is None else 2)
    assert arms == {None: [1, 2, 3, 4], 1: [1, 1, 2, 3, 4], 3: [1, 2, 3, 1, 2]}[refused_at]
    truths = [trial["error_before"] for trial in row["trials"]]
    assert truths == [pytest.approx(start, abs=1.6) for start in STARTS], "the object is where its label says"


def test_a_start_from_which_the_object_goes_in_has_no_label_and_moves_none_of_the_others(tmp_path):
    world = World("cell")
    given = with_care(client(), world, "rectangle", None)
    starts = [(0.2, 0.1), STARTS[1]]
    asked = job_in(world, "rectangle", 0, STARTS[0], 3, purpose="probe", starts=starts, client=given)
    row = play(Episode(tmp_path / "cell" / "00000", released_models(), asked))
    assert row["grasps"] == 2
    assert read_episodes(tmp_path / "cell", Sensor.load()).error.tolist() == [list(STARTS[0]), list(STARTS[1])]


def test_a_press_in_which_the_arm_paused_is_made_again_and_not_stored(tmp_path):
    """Cameras that lose a tenth of their frames: the lease ends in one press."""
    tables = drawn.draw_worlds(12, 105)[4]
    tables["gel"]["tier"] = "bristle"
    tables["camera"] |= {"fps": 30.0, "dropped_share": 0.1}
    row = probed(tmp_path / "cell" / "00000", drawn.world(tables, "slow cameras"))
    reasons = [trial["decision"].get("reason") for trial in row["trials"]]
    assert (reasons.count("stale"), row["grasps"]) == (1, 2)
    made = read_episodes(tmp_path / "cell", Sensor.load()).error.tolist()
    assert sorted(made) == sorted(map(list, STARTS))


def test_an_object_that_always_hangs_turned_ends_it(tmp_path, monkeypatch):
    def hear(insertion, messages):
        for message in messages:
            named = {"insertion_id": message.insertion_id, "attempt": getattr(message, "attempt", 1)}
            refused = wire.Refused(**named, reason="turned_in_hand", detail="it is tilted")
            message_then = refused if isinstance(message, wire.Armed) else message
            insertion._post(FromService(at_s=insertion.cell.now_s, message=message_then))

    monkeypatch.setattr(Insertion, "_hear", hear)
    row = probed(tmp_path / "00000")
    assert (row["grasps"], row["trials"]) == (episodes.GRASPS_N, [])
    assert row["reason"].startswith(REFUSED)
    assert "starts" not in json.loads((tmp_path / "00000" / "summary.json").read_text())
