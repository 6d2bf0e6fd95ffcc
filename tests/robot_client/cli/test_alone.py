"""One client moves a cell at a time, and each says what will move before it does."""

import subprocess
import sys

import pytest

from robot_client.cli import jog as jogging
from robot_client.cli import main as command_line
from robot_client.cli.alone import alone
from robot_client.cli.main import main
from robot_client.cli.terminal import Outcome
from robot_client.ports import NOT_CONFIRMED, DriverError
from robot_client.settings import load_settings

AT = "127.0.0.1:9"
KEEPS = """
import sys
from robot_client.cli.alone import alone
from robot_client.settings import load_settings
with alone(load_settings(None, {"gripper": {"host": "127.0.0.1", "port": 9}})):
    print("kept", flush=True)
    sys.stdin.read()
"""


COMMANDS = [["jog", "--z-mm", "60"], ["home"], ["insert", "--uncommissioned"], ["cycle"], ["commission"]]


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "cell.toml"
    path.touch()
    return str(path)


@pytest.mark.parametrize("command", [*COMMANDS, ["try", "arm"]])
def test_nothing_moves_by_what_is_built_in(command, capsys):
    assert main([*command, "--live", "--gripper", AT]) == 2
    shown = capsys.readouterr()
    assert (shown.out, shown.err.startswith("error: --live expects --config FILE")) == ("", True)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_second_client_of_a_cell_moves_nothing(command, config, capsys):
    settings = load_settings(None, {"gripper": {"host": "127.0.0.1", "port": 9}})
    with alone(settings):
        assert main([*command, "--live", "--config", config, "--gripper", AT]) == 1
    assert f"another client has the cell with the gripper {AT}: end it first" in capsys.readouterr().err
    with alone(settings), alone(load_settings(None, {"gripper": {"host": "127.0.0.1", "port": 10}})):
        pass  # nor does a cell keep out the next insertion, or another cell


def test_a_client_that_was_killed_keeps_nobody_out():
    settings = load_settings(None, {"gripper": {"host": "127.0.0.1", "port": 9}})
    with subprocess.Popen([sys.executable, "-c", KEEPS], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout.readline() == b"kept\n"
        with pytest.raises(DriverError, match="another client"), alone(settings):
            pass
        other.kill()
        other.wait()
        with alone(settings):
            pass


@pytest.mark.parametrize(("slow", "stated_mm_s"), [({}, 80), ({"travel"}, 25), ({"travel", "retract"}, 10)])
def test_a_jog_says_where_it_will_go_before_it_connects(monkeypatch, capsys, tmp_path, slow, stated_mm_s):
    async def jog(_settings, _target):
        connected.append(capsys.readouterr().out)
        return Outcome(True, {})

    connected = []
    monkeypatch.setattr(jogging, "_jog", jog)
    (config := tmp_path / "cell.toml").write_text("".join(f"[ramps.{ramp}]\nspeed_mm_s = 10.0\n" for ramp in slow))
    assert main(["jog", "--live", "--config", str(config), "--z-mm", "60", "--gripper", AT]) == 0
    printed = " ".join(connected[0].split())
    assert "will go up to z +35.00 mm at least, over, then down to x +0.00, y +0.00, z +60.00 mm" in printed
    assert f"at up to {stated_mm_s} mm/s and with no watch for touch" in printed


@pytest.mark.parametrize("interrupted", [False, True])
def test_an_arm_that_may_still_move_has_not_failed_safe(monkeypatch, config, capsys, interrupted):
    """Nor does nothing move, if somebody presses Ctrl-C because the terminal takes no more lines, as after Ctrl-S."""

    def press():
        raise KeyboardInterrupt

    if interrupted:
        monkeypatch.setattr(command_line, "printed", press)

    def unstopped(*_arguments, **_options):
        raise DriverError(f"robot: {NOT_CONFIRMED} by the controller: use the stop button")

    monkeypatch.setattr(command_line, "jog", unstopped)
    assert main(["jog", "--live", "--config", config, "--z-mm", "60", "--gripper", AT]) == 1
    assert capsys.readouterr().err.startswith("FAILED: robot: STOP NOT CONFIRMED")
