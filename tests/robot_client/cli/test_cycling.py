"""`cycle` as an operator starts it: what it prints where something goes wrong."""

import asyncio
from dataclasses import replace
from pathlib import Path

import pytest

from robot_client.cli.commission import Probing
from robot_client.cli.cycle import _cycle
from robot_client.cli.insert import _insert, make_plan
from robot_client.cli.main import main
from robot_client.cli.terminal import printed
from robot_client.grippers.dry_run.driver import DryGripper
from robot_client.insertion.state import Phase, State
from robot_client.ports import DriverError
from robot_client.session.afresh import Fixture
from robot_client.session.cycle import CycleSettings
from robot_client.session.recorder import Recorder
from robot_client.session.runner import Runner
from robot_client.settings import load_settings
from service.contract import wire
from tests.robot_client.cycle_cell import PICK, cell_with, run, turned

TAUGHT = "[cycle]\nopen_mm = 80\n[cycle.pick]\nx_mm = 0\ny_mm = 0\nz_mm = 45\nyaw_deg = 0\n"


def test_a_part_that_is_not_there_is_named_with_the_controllers_answer_and_a_lost_log(tmp_path, capsys, monkeypatch):
    def full(self, _line):
        self.lost = "No space left on device"

    monkeypatch.setattr(Recorder, "_write", full)

    async def story():
        async with cell_with() as (cell, part):
            part.is_there = lambda: False
            plan = make_plan(cell.settings, 0.0, 0.0, None, None)
            return await _cycle(cell.settings, cell.settings.cycle, 1, Path(tmp_path), plan)

    outcome = run(story)
    printed()
    lines = capsys.readouterr().out
    assert not outcome.done
    assert "on nothing; is the object between the fingers?" in outcome.result["reason"]
    assert "robot: controller confirms: program stopped" in lines
    (log,) = tmp_path.iterdir()
    assert f"insertion {log.stem}\n" in lines, "the name of its recording, and of its lines in the service's log"
    assert "BROKEN OFF: No space left on device" in lines


def test_a_gripper_of_ones_own_that_is_not_there_holds_the_cycle_which_says_what_it_has_done(monkeypatch, capsys):
    """Its driver may raise the system's own error."""

    async def gone(_gripper):
        raise ConnectionResetError(104, "Connection reset by peer")

    monkeypatch.setattr(DryGripper, "connect", gone)
    taught = CycleSettings(pick=PICK, open_mm=80.0)
    settings = load_settings(None, {"robot": {"device": "dry_run"}, "gripper": {"device": "dry_run"}})
    outcome = asyncio.run(_cycle(settings, taught, 1, None, make_plan(settings, 0.0, 0.0, None, None)))
    printed()
    assert (outcome.done, outcome.result["reason"]) == (False, "Connection reset by peer")
    assert capsys.readouterr().out.splitlines()[-2:] == ["HOLD  Connection reset by peer", "0 inserted"]


def test_nothing_is_let_go_of_while_nobody_confirms_that_the_arm_has_stopped(monkeypatch):
    async def story():
        async with cell_with(seed=10) as (cell, part):
            rws = cell.settings.robot.rws.model_copy(update={"stop_timeout_s": 0.3})
            robot = cell.settings.robot.model_copy(update={"rws": rws})
            settings = cell.settings.model_copy(update={"robot": robot})
            monkeypatch.setattr(cell, "settings", settings)

            def ignore_the_stop(message):
                if isinstance(message, wire.Stopped):
                    cell.board.update({"rws": {"stop_ignored": True}})

            cell.service.on_message = ignore_the_stop
            outcome = await _cycle(settings, settings.cycle, 1, None, make_plan(settings, 0.0, 0.0, None, None))
            return outcome, part.left, part.held

    outcome, left, held = run(story)
    assert "STOP NOT CONFIRMED" in outcome.result["reason"]
    assert (outcome.done, outcome.result["inserted"], left, held) == (False, 0, [], True)


@pytest.mark.parametrize("command", ["insert", "commission"])
def test_no_object_is_put_back_while_nobody_confirms_that_the_arm_has_stopped(command, tmp_path, monkeypatch):
    """After a turn in the hand, or a probe, the arm would go to the fixture, where the fingers open."""
    put_back = []

    async def ends(runner):
        plan, runner.farewell = runner.plan, "STOP NOT CONFIRMED by the controller"
        if plan.only_probes:
            return replace(State(plan), phase=Phase.PROBED)
        turned = "service: refused: turned_in_hand: by 1.4 deg"
        return replace(State(plan), phase=Phase.FAILED, attempt=2, armed=plan.approach, reason=turned)

    async def note(*way):
        put_back.append(way)

    monkeypatch.setattr(Runner, "run", ends)
    monkeypatch.setattr(Fixture, "put_back", note)
    taught = CycleSettings(pick=PICK, open_mm=80.0)
    settings = load_settings(None, {"robot": {"device": "dry_run"}, "gripper": {"device": "dry_run"}})
    settings = settings.model_copy(update={"cycle": taught})
    plan = make_plan(settings, 0.0, 0.0, None, None)
    steps = {
        "insert": lambda: _insert(settings, plan, live=True, log=None),
        "commission": lambda: Probing(settings, taught, tmp_path).probe(8.0, 8.0),
    }
    with pytest.raises(DriverError, match="STOP NOT CONFIRMED"):
        asyncio.run(steps[command]())
    assert put_back == []


def test_a_part_is_not_put_back_into_a_fixture_that_fills_up_again():
    async def story():
        async with cell_with(seed=1) as (cell, part):  # its first attempt is blocked
            taught = cell.settings.cycle.model_copy(update={"regrasp": False})
            settings = cell.settings.model_copy(update={"cycle": taught})
            takes_afresh = []

            def refuse(message):
                if isinstance(message, wire.ClientHello):
                    takes_afresh.append(message.takes_afresh)
                return [turned(message)] if isinstance(message, wire.Arm) and message.attempt == 2 else None

            cell.service.on_message = refuse
            outcome = await _cycle(settings, taught, 1, None, make_plan(settings, 0.0, 0.0, None, None))
            return outcome, takes_afresh, part.held, cell.cabinet.arm.pose.position_mm[0]

    outcome, takes_afresh, held, x_mm = run(story)
    assert "turned_in_hand" in outcome.result["reason"]
    assert (takes_afresh, held) == ([False], True)
    assert x_mm > 0.0, "above the gap, not at the fixture"


@pytest.mark.parametrize(
    ("keys", "expect"),
    [
        ("", ["put it back at the pick, which has to be empty", "AT ONCE: the gap has to be free again by itself"]),
        ("regrasp = false\n[cycle.plc]\n", ["as if not inserted", "only when the PLC asks for it"]),
    ],
)
def test_a_cycle_says_what_it_takes_for_granted_before_anything_moves(keys, expect, tmp_path, capsys):
    path = tmp_path / "cell.toml"
    path.write_text(f"[cycle]\nopen_mm = 80\npick = {{x_mm = -20, y_mm = 0, z_mm = 45, yaw_deg = 0}}\n{keys}")
    assert main(["cycle", "--config", str(path)]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    for words in expect:
        assert words in shown


@pytest.mark.parametrize("command", ["cycle", "commission"])
@pytest.mark.parametrize("mode", ["--live", "--dry-run"])
@pytest.mark.parametrize(
    ("toml", "expect"),
    [
        ("[task]\nexpected_depth_mm = 60.0", "plan z_mm = -2"),
        ("[task]\napproach_z_mm = 3.5\n", "plan z_mm"),
        ("[ramps.travel]\nspeed_mm_s = 500.0\nacceleration_mm_s2 = 1.0\njerk_mm_s3 = 1.0", "ramps.travel"),
        ("[lease]\nstop_lag_s = 40.0", "lease"),
    ],
)
def test_nothing_is_picked_for_a_plan_that_would_be_refused(command, mode, toml, expect, tmp_path, capsys):
    """The devices are nowhere: connecting would end with 1, not with 2."""
    path = tmp_path / "cell.toml"
    nowhere = '[gripper]\nhost = "127.0.0.1"\nport = 1\n[robot]\nrws.url = "http://127.0.0.1:1"'
    path.write_text(f"simulated = true\n{toml}\n{nowhere}\n{TAUGHT}")
    out = ["--out", str(tmp_path / "record")] if command == "commission" else []
    assert main([command, mode, "--config", str(path), *out]) == 2
    assert expect in capsys.readouterr().err


@pytest.mark.parametrize("mode", [["--live"], []])
def test_nothing_is_commissioned_at_a_fixture_that_fills_up_again(mode, tmp_path, capsys):
    """Each probe puts the object back there, where the feeder has put another one."""
    (tmp_path / "cell.toml").write_text(TAUGHT.replace("[cycle]\n", "[cycle]\nregrasp = false\n"))
    paths = ["--config", str(tmp_path / "cell.toml"), "--out", str(tmp_path / "record")]
    assert main(["commission", *mode, *paths, "--gripper", "127.0.0.1:9", "--rws-url", "http://127.0.0.1:9"]) == 2
    shown = capsys.readouterr()
    assert (shown.out, shown.err.count("\n")) == ("", 1)
    assert "stop the feeder" in shown.err
    assert "cycle.regrasp = true" in shown.err


@pytest.mark.parametrize("command", [["cycle", "--uncommissioned", "--logs"], ["commission", "--out"]])
@pytest.mark.parametrize("folder", ["/dev/null", "/proc/none"])
def test_a_folder_that_takes_no_files_is_refused_before_anything_moves(command, folder, tmp_path, capsys):
    (tmp_path / "cell.toml").write_text(TAUGHT)
    nowhere = ["--gripper", "127.0.0.1:9", "--rws-url", "http://127.0.0.1:9"]
    assert main([*command, folder, "--live", "--config", str(tmp_path / "cell.toml"), *nowhere]) == 2
    shown = capsys.readouterr()
    assert (shown.out, shown.err.count("\n")) == ("", 1)
    assert folder in shown.err


def test_a_rehearsed_commissioning_refuses_a_seed_that_a_live_one_would(tmp_path, capsys):
    (tmp_path / "cell.toml").write_text(TAUGHT)
    assert main(["commission", "--seed", "-1", "--config", str(tmp_path / "cell.toml")]) == 2
    assert "--seed -1: expected 0 or more" in capsys.readouterr().err
