"""The command line: a rehearsal by default, one clear line for wrong input, and exit codes that scripts can trust."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

import robot_client
from robot_client.__main__ import main
from robot_client.cli.check import _check
from robot_client.cli.home import _home
from robot_client.cli.insert import _insert, make_plan
from robot_client.cli.jog import _jog
from robot_client.cli.terminal import printed
from robot_client.grippers.wsg50.link import GripperError
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.motion import Ramps
from robot_client.ports import DriverError
from robot_client.robots.dry_run.driver import DryArm
from robot_client.session.recorder import Recorder, read_log
from robot_client.settings import SettingsError, load_settings
from service.contract import wire
from tests.robot_client.live_cell import bench


@pytest.mark.parametrize(
    ("toml", "expect"),
    [
        ("[limits]\nmax_dx = 3", "limits.max_dx: unknown key; did you mean 'max_dx_mm'?"),
        ("[limits]\nx_mm = [1]", "limits.x_mm"),
        ("[limits]\nmax_dx_mm = nan", "limits.max_dx_mm"),
        ("[robot\n", "cannot read configuration"),
        ("[robot]\nport = -5", "robot.port"),
        ("[robot]\nsilence_s = -1.0", "robot.silence_s"),
        ("[robot]\nsilence_s = 250", "robot.silence_s: expected a number > 0 and <= 30"),
        ("[robot]\nmax_age_s = 250", "robot.max_age_s: expected a number > 0 and <= 30"),
        ('[robot]\ndevice = "abb_rapid"\nsilence_s = 500', "robot.silence_s: expected a number > 0 and <= 30"),
        ("[gripper]\nsilence_s = 500", "gripper.silence_s: expected a number > 0 and <= 30"),
        ("[service]\nsilence_s = 750", "service.silence_s: expected a number > 0 and <= 30"),
        ('[service]\nurl = "http://127.0.0.1"', "service.url"),
        ("[service]\nheartbeat_s = 0.75", "service: silence_s = 0.75, expected more than heartbeat_s = 0.75"),
        ("[limits]\nmax_attempts = 3.0", "limits.max_attempts: expected a whole number >= 1 and <= 15"),
        ("[task]\ngap_width_mm = -1", "task.gap_width_mm"),
        ("[limits]\nz_mm = [5, 900]\n[task]\napproach_z_mm = 600", "grasp_height_mm"),
        ("[timeouts]\ndeciding_s = 0", "timeouts.deciding_s"),
        ("[work_object]\nrotation = [0, 0, 0, 0]", "no rotation"),
        (
            "[cycle]\nopen_mm = 80\n[cycle.pick]\nx_mm = 300\ny_mm = 0\nz_mm = 45\nyaw_deg = 0",
            "cycle.pick x_mm = 300.000, allowed -40 .. 40",
        ),
        (
            "[cycle]\nopen_mm = 80\n[cycle.pick]\nx_mm = 0\ny_mm = 0\nz_mm = 115\nyaw_deg = 0",
            "above cycle.pick z_mm = 155.000, allowed 5 .. 150",
        ),
        (
            "[cycle]\nopen_mm = 80\nretreat_mm = 0.04\n[cycle.pick]\nx_mm = 0\ny_mm = 0\nz_mm = 45\nyaw_deg = 0",
            "cycle.retreat_mm: Input should be greater than or equal to 1",
        ),
        ("[task]\nexpected_depth_mm = 4", "expected_depth_mm less its tolerance is 3"),
        ("[task]\ndepth_tolerance_mm = 1.5", "task.depth_tolerance_mm: expected a number > 0 and <= 1"),
        ("[ramps.travel]\nspeed_mm_s = 0\nacceleration_mm_s2 = 1\njerk_mm_s3 = 1", "limits"),
    ],
)
def test_a_wrong_configuration_is_one_line_and_exit_code_two(toml, expect, tmp_path, capsys):
    path = tmp_path / "cell.toml"
    path.write_text(toml)
    code = main(["insert", "--config", str(path), "--log", str(tmp_path / "x.jsonl")])
    err = capsys.readouterr()
    assert code == 2 or (code == 1 and "limits" in err.out)
    assert expect in err.err + err.out


@pytest.mark.parametrize(
    "arguments",
    [
        ["--gripper", "nohost"],
        ["--config", "/nonexistent.toml"],
        ["--egm-port", "99999"],
        ["--rws-url", "nope"],
        ["--rws-url", "http://192.168.125.1:99999"],
        ["--rws-url", "http://[::1"],
        ["--rws-url", "http://\u2603.example"],
        ["--gap-width-mm", "2000"],
        ["--expected-depth-mm", "2000"],
        ["--x-mm", "1e308"],
        ["--insertion-id", "../../x"],
        ["--log", "/dev/null/x.jsonl"],
    ],
)
def test_wrong_arguments_are_one_line_and_exit_code_two(arguments, capsys):
    assert main(["insert", *arguments]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_rehearsal_says_what_the_arm_would_refuse(tmp_path, capsys):
    path = tmp_path / "cell.toml"
    path.write_text("[limits]\nmax_turn_deg_s = 5")
    assert main(["insert", "--x-mm", "0", "--theta-deg", "9", "--config", str(path), "--log", str(tmp_path / "x")]) == 1
    out = " ".join(capsys.readouterr().out.split())
    assert "HOLD limits: plan: limits.max_turn_deg_s = 5, and turns reach 55 on ramps.travel: lower" in out


def test_a_section_that_is_no_table_is_refused_beside_an_option_of_it(tmp_path, capsys):
    path = tmp_path / "cell.toml"
    path.write_text("robot = 3")
    assert main(["insert", "--config", str(path), "--egm-port", "6511"]) == 2
    assert "robot" in capsys.readouterr().err


def test_a_full_disk_ends_the_log_and_not_the_insertion(tmp_path, capsys, monkeypatch):
    kept = Recorder._write

    def fills_up(self, line):
        if self.written > 5 and self._file is not None and self._file.name != "/dev/full":
            self._file.close()
            self._file = Path("/dev/full").open("w", encoding="utf-8", buffering=1)  # noqa: SIM115 the recorder closes it
        self.written += 1
        kept(self, line)

    monkeypatch.setattr(Recorder, "written", 0, raising=False)
    monkeypatch.setattr(Recorder, "_write", fills_up)
    log = tmp_path / "episode.jsonl"
    assert main(["insert", "--x-mm", "8", "--log", str(log)]) == 0
    assert "BROKEN OFF: No space left on device" in capsys.readouterr().out
    assert read_log(log)[1]


def test_the_password_can_come_from_the_environment_and_is_never_shown(monkeypatch):
    monkeypatch.setenv("TACTILE_INSERTION_RWS_PASSWORD", "secret")
    settings = load_settings(None)
    assert settings.robot.rws.password.get_secret_value() == "secret"
    assert "secret" not in repr(settings)


def test_a_ramp_of_which_one_key_is_stated_keeps_the_others():
    ramps = load_settings(None, {"ramps": {"descend": {"speed_mm_s": 4.0}}}).ramps
    assert ramps.descend == Ramps().descend.model_copy(update={"speed_mm_s": 4.0})
    assert (ramps.travel, ramps.retract) == (Ramps().travel, Ramps().retract)
    with pytest.raises(SettingsError, match=r"ramps.descend.speed: unknown key; did you mean 'speed_mm_s'"):
        load_settings(None, {"ramps": {"descend": {"speed": 4.0}}})


def test_without_live_nothing_is_connected(capsys):
    assert main(["jog", "--z-mm", "60", "--dry-run"]) == 0
    assert main(["home", "--acknowledge"]) == 0
    assert main(["jog", "--z-mm", "500"]) == 2
    assert capsys.readouterr().out.count("DRY RUN") == 2


@pytest.mark.parametrize(
    ("arguments", "code", "expect"),
    [
        (["jog", "--z-mm", "60"], 0, {"done": True, "live": False}),
        (["home"], 0, {"done": True, "steps": ["home default"]}),
        (["jog", "--z-mm", "500"], 2, {"done": False, "error": "target z_mm = 500.000, allowed 5 .. 150"}),
        (["check", "--service", "ws://127.0.0.1:9", "--rws-url", "http://127.0.0.1:9"], 1, {"ready": False}),
    ],
)
def test_json_is_all_that_goes_to_stdout_and_agrees_with_the_exit_code(arguments, code, expect, capsys):
    assert main([*arguments, "--json", "--gripper", "127.0.0.1:9"]) == code
    out, err = capsys.readouterr()
    result = json.loads(out)
    assert result["done"] == (code == 0)
    assert expect.items() <= result.items()
    assert err


def test_the_json_of_an_insertion_and_of_its_replay_agree(tmp_path, capsys):
    log = tmp_path / "episode.jsonl"
    assert main(["insert", "--x-mm", "8", "--log", str(log), "--json"]) == 0
    inserted = json.loads(capsys.readouterr().out)
    assert main(["replay", str(log), "--json"]) == 0
    replayed = json.loads(capsys.readouterr().out)
    assert (inserted["log"], inserted["phase"], inserted["attempts"]) == (str(log), "inserted", replayed["attempts"])


def test_json_is_printed_whatever_a_drivers_statistics_hold(tmp_path, monkeypatch, capsys):
    figures = {"worst_ms": float("nan"), "gaps_ms": {(0, 4): 2}, "raw": b"\xff", "cycles": 3}
    monkeypatch.setattr(DryArm, "statistics", lambda _arm: figures)
    assert main(["insert", "--x-mm", "8", "--log", str(tmp_path / "episode.jsonl"), "--json"]) == 0
    link = json.loads(capsys.readouterr().out)["link"]
    assert link == {"worst_ms": None, "gaps_ms": {"0,4": 2}, "raw": "ff", "cycles": 3}


def test_the_last_screen_counts_the_attempts_of_all_grasps(monkeypatch, capsys):
    """A rehearsed object never turns in the hand, so earlier grasps are added to it here."""

    async def after_a_regrasp(plan, run, *_):
        state = await run(plan)
        return replace(state, attempt=state.attempt + 2)

    monkeypatch.setattr("robot_client.cli.insert.upright", after_a_regrasp)
    assert main(["insert", "--x-mm", "8", "--json"]) == 0
    out, err = capsys.readouterr()
    assert f"INSERTED after {json.loads(out)['attempts']} attempts" in err


async def test_check_reads_every_device_and_moves_nothing(capsys):
    async with bench() as cell:
        outcome = await _check(cell.settings)
        moved = {pose.position_mm for _, _, pose in cell.trace}
        commands = set(cell.wsg.counters.commands)
        running, received = cell.cabinet.running, cell.service.received
    printed()
    out = capsys.readouterr().out
    assert outcome.done, out
    assert len(moved) == 1
    assert not running
    assert not commands & {"GRASP", "MOVE", "RELEASE", "HOMING", "STOP", "ACKNOWLEDGE"}
    assert [message.role for message in received] == ["watch"]
    assert "ready to insert" in out


async def test_check_names_what_is_not_ready(capsys):
    async with bench(overrides={"service": {"url": "ws://127.0.0.1:9"}}) as cell:
        cell.board.update({"robot": {"mode": "MANF"}, "gripper": {"not_homed": True}})
        assert not (await _check(cell.settings)).done
    printed()
    out = capsys.readouterr().out
    assert "BAD  robot     operating mode MANF" in out
    assert "not homed" in out
    assert "BAD  service" in out


async def test_jog_goes_up_over_and_down(capsys):
    async with bench() as cell:
        outcome = await _jog(cell.settings, WorkPose(x_mm=-4.0, y_mm=1.0, z_mm=36.0, yaw_deg=-5.0))
        pose, path = cell.cabinet.arm.pose, [pose for _, _, pose in cell.trace]
    assert outcome.done
    assert pose.position_mm == pytest.approx((-4.0, 1.0, 36.0), abs=0.05)
    assert pose.yaw_deg == pytest.approx(-5.0, abs=0.1)
    assert min(p.position_mm[2] for p in path if p.position_mm[0] > -3.9) > 39.9


async def test_jog_fails_safe_when_the_robot_stops(capsys):
    async with bench() as cell:

        def stop_on_the_way():
            if cell.cabinet.arm.pose.position_mm[2] > 45.0:
                cell.board.update({"robot": {"protective_stop": True}})

        cell.egm.on_cycle.append(stop_on_the_way)
        with pytest.raises(DriverError, match="motors are off"):
            await _jog(cell.settings, WorkPose(x_mm=-30.0, y_mm=0.0, z_mm=100.0, yaw_deg=0.0))


async def test_home_refuses_to_drop_a_part_and_acknowledges_only_on_request(capsys):
    async with bench(holding=True) as cell:
        for _ in range(2):  # after the first time it has forgotten its part, as after any client
            with pytest.raises(GripperError, match="would drop"):
                await _home(cell.settings, acknowledge=False, direction="default")
        assert cell.gripper.holding
    async with bench(holding=False) as cell:
        cell.gripper.fast_stop()
        with pytest.raises(GripperError, match="fault FAST_STOP; find the cause"):
            await _home(cell.settings, acknowledge=False, direction="default")
        assert "ACKNOWLEDGE" not in cell.wsg.counters.commands
        assert (await _home(cell.settings, acknowledge=True, direction="outward")).done


def test_the_configuration_in_the_readme_is_valid_and_is_the_default(tmp_path):
    readme = (Path(robot_client.__file__).parent / "README.md").read_text()
    path = tmp_path / "cell.toml"
    path.write_text(readme.split("```toml\n")[1].split("```")[0])
    assert load_settings(path) == load_settings(None)


async def test_a_services_text_cannot_command_the_operators_terminal(capsys):
    async with bench() as cell:
        detail = "\x1b[2J\x1b]0;owned\x07\rINSERTED after 1 attempt\nINSERTED\x9b1A\u202e"
        fault = wire.Fault(insertion_id="any", code="internal", detail=detail)
        cell.service.on_message = lambda message: [fault] if message.type == "hello" else None
        plan = make_plan(cell.settings, 8.0, 6.0, "hostile", None)
        assert not (await _insert(cell.settings, plan, live=True, log=None)).done
    printed()
    shown = capsys.readouterr().out
    assert shown.replace("\n", "").isprintable()
    assert "\\x1b[2J\\x1b]0;owned\\x07\\rINSERTED" in shown
    assert not any(line.startswith("INSERTED") for line in shown.splitlines())


@pytest.mark.parametrize("word", ["--l", "--li", "--liv"])
def test_nothing_shorter_than_live_is_taken_for_it(word, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["home", word])
    assert ended.value.code == 2
    assert "unrecognized arguments" in capsys.readouterr().err
