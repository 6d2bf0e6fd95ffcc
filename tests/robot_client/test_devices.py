"""A new arm or gripper is one folder and one line; an unknown one is refused with the nearest known name."""

import subprocess
import sys

import pytest

from robot_client import devices
from robot_client.__main__ import main
from robot_client.cli.insert import make_plan
from robot_client.insertion.state import Phase
from robot_client.session.recorder import Recorder
from robot_client.session.rehearsal import DryService
from robot_client.session.runner import Runner
from robot_client.settings import SettingsError, load_settings

GRIPPER = """
import time
from typing import Literal
from robot_client.insertion.events import Grasped
from robot_client.ports import DeviceSettings, Finding, Gripper

class Settings(DeviceSettings):
    device: Literal["claw"] = "claw"
    width_mm: float = 44.0

class Claw(Gripper):
    def __init__(self, settings):
        self.settings = settings

    async def start(self, post):
        self.post = post

    def grasp(self):
        self.post(Grasped(at_s=time.monotonic(), width_mm=self.settings.width_mm))

    async def close(self):
        pass

    def checks(self):
        return {"claw": self.check}

    async def connect(self):
        pass

    async def check(self):
        return [Finding(True, "nails are short")]

    async def home(self, direction):
        return self.settings.width_mm

make = Claw
"""
ARM = """
import asyncio, time
from typing import Literal
from robot_client.insertion.events import Arrived, Standstill
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.motion import CYCLE_S, MotionGuide
from robot_client.ports import Arm, DeviceSettings, Finding

class Settings(DeviceSettings):
    device: Literal["crane"] = "crane"
    hook_mm: float = 70.0

class Crane(Arm):
    on_target = staticmethod(lambda pose: None)

    def __init__(self, settings, limits, ramps, frame):
        start = WorkPose(x_mm=0.0, y_mm=0.0, z_mm=settings.hook_mm, yaw_deg=0.0)
        self.guide, self.swings = MotionGuide(limits, ramps, start), None

    async def start(self, post):
        self.post, self.swings = post, asyncio.get_running_loop().create_task(self.swing())
        return self.guide.target

    def move(self, target, motion, until_s=None):
        self.guide.move(target, motion, until_s)

    def renew(self, until_s):
        self.guide.renew(until_s)

    def hold(self, reason, *, stop):
        self.guide.hold()

    async def close(self):
        if self.swings:
            self.swings.cancel()
        return "the crane is parked"

    def position(self):
        return self.guide.target

    def target(self):
        return self.guide.target

    def statistics(self):
        return {}

    def checks(self):
        return {"crane": self.check}

    async def check(self):
        return [Finding(False, "no crane driver in sight")]

    async def swing(self):
        cycles = 0
        while True:
            cycles += 1
            pose = self.guide.advance(CYCLE_S, time.monotonic())
            self.on_target(pose)
            settled = self.guide.observe(pose, cycles * CYCLE_S)
            if settled:
                self.post((Arrived if settled == "arrived" else Standstill)(at_s=time.monotonic(), pose=pose))
            await asyncio.sleep(0.0)

make = Crane
"""
CONFIG = """
[robot]
device = "crane"
[gripper]
device = "claw"
width_mm = 43.0
[service]
url = "ws://127.0.0.1:9"
"""


@pytest.fixture
def config(tmp_path, monkeypatch):
    """A configuration that names two devices, each a folder and a line."""
    for name, driver in (("claw", GRIPPER), ("crane", ARM)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").touch()
        (tmp_path / name / "driver.py").write_text(driver)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(devices.GRIPPERS, "claw", "claw.driver")
    monkeypatch.setitem(devices.ROBOTS, "crane", "crane.driver")
    path = tmp_path / "cell.toml"
    path.write_text(CONFIG)
    yield path
    for name in [name for name in sys.modules if name.split(".")[0] in {"claw", "crane"}]:
        del sys.modules[name]


async def test_a_new_arm_and_a_new_gripper_insert(config):
    settings = load_settings(config)
    plan = make_plan(settings, 8.0, 6.0, "toy", None)
    arm, gripper = settings.make_arm(), settings.make_gripper()
    service = DryService("toy", settings.limits, plan.approach.z_mm)
    arm.on_target = service.watch
    run = Runner(plan, arm, gripper, service, Recorder(None, plan))
    state, farewell = await run.run(), run.farewell
    assert (state.phase, state.attempt) == (Phase.INSERTED, 3), state.reason
    assert farewell == "the crane is parked"


def test_the_commands_check_and_home_reach_a_new_device(config, capsys):
    assert main(["check", "--config", str(config)]) == 1
    assert main(["home", "--live", "--config", str(config)]) == 0
    assert main(["home", "--live", "--acknowledge", "--config", str(config)]) == 1
    out, err = capsys.readouterr()
    assert "BAD  crane     no crane driver in sight" in out
    assert "ok   claw      nails are short" in out
    assert "homed, width 43.0 mm" in out
    assert "no fault to acknowledge" in err


def test_a_gripper_that_is_not_there_is_named_in_every_command(config, capsys):
    """A driver may raise the system's own error."""
    driver = config.parent / "claw" / "driver.py"
    refused = 'raise ConnectionRefusedError(111, "Connection refused")'
    driver.write_text(
        GRIPPER.replace(
            "async def connect(self):\n        pass", f"async def connect(self):\n        {refused}"
        ).replace("async def check(self):\n", "async def check(self):\n        await self.connect()\n")
    )
    assert main(["check", "--config", str(config)]) == 1
    assert "BAD  claw      claw: Connection refused" in capsys.readouterr().out
    assert main(["home", "--live", "--config", str(config)]) == 1
    assert capsys.readouterr().err == "FAILED SAFE: Connection refused\n"


@pytest.mark.parametrize(
    ("wrong", "right", "expect"),
    [
        ("make = Claw", "", "is no module with Settings and make: module 'claw.driver' has no attribute 'make'"),
        ("make = Claw", "make =", "is no module with Settings and make: invalid syntax (driver.py, line "),
        ("(DeviceSettings)", "", "expected a class of DeviceSettings"),
    ],
)
def test_a_module_that_is_no_device_is_refused_by_the_rehearsal(config, capsys, wrong, right, expect):
    (config.parent / "claw" / "driver.py").write_text(GRIPPER.replace(wrong, right))
    assert main(["insert", "--config", str(config)]) == 2
    assert expect in capsys.readouterr().err


def test_a_driver_that_lacks_an_order_is_refused_by_name(config, capsys):
    """A misspelt one would do nothing, silently."""
    driver = config.parent / "claw" / "driver.py"
    driver.write_text(GRIPPER.replace("def grasp(self)", "def grip(self)"))
    assert main(["check", "--config", str(config)]) == 2
    assert "error: device: 'claw' cannot be made: Can't instantiate abstract class Claw" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("toml", "expect"),
    [
        ('[gripper]\ndevice = "claw"', "gripper.device: 'claw' is unknown; allowed: dry_run, wsg50 (a module of your"),
        ('[robot]\ndevice = "abb_egn"', "robot.device: 'abb_egn' is unknown; did you mean 'abb_egm'?"),
        ('[gripper]\ndevice = "wsg5"', "gripper.device: 'wsg5' is unknown; did you mean 'wsg50'?"),
        ("[gripper]\ndevice = 3", "gripper.device: 3 is unknown; allowed: dry_run, wsg50"),
        ("[gripper]\nforce_limit = 3", "gripper.force_limit: unknown key; did you mean 'force_limit_n'?"),
        ("[robot.rws]\nurls = 3", "robot.rws.urls: unknown key; did you mean 'url'?"),
        ('[robot]\ndevice = "abb_rapid"\nbind = "x"', "robot.bind: unknown key; allowed: connect_timeout_s"),
        ("gripper = 3", "gripper: expected a table of keys"),
        ("[griper]\nport = 3", "griper: unknown key; did you mean 'gripper'?"),
    ],
)
def test_an_unknown_device_or_key_is_refused_with_file_key_and_nearest(tmp_path, capsys, toml, expect):
    path = tmp_path / "cell.toml"
    path.write_text(toml)
    assert main(["insert", "--config", str(path)]) == 2
    err = capsys.readouterr().err
    assert f"error: {path}: {expect}" in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    "name",
    ["TACTILE_INSERTION_RWS_PASWORD", "TACTILE_RWS_PASSWORD", "TACTILE_INSERTION_X", "tactile_insertion_rws_password"],
)
def test_a_variable_that_no_device_reads_is_refused_with_the_nearest(monkeypatch, name):
    monkeypatch.setenv(name, "secret")
    with pytest.raises(
        SettingsError, match=f"environment: {name} is not used.*TACTILE_INSERTION_RWS_PASSWORD"
    ) as error:
        load_settings(None)
    assert "secret" not in str(error.value)


def test_a_password_is_not_swallowed_by_a_device_that_has_none(monkeypatch):
    monkeypatch.setenv("TACTILE_INSERTION_RWS_PASSWORD", "secret")
    with pytest.raises(SettingsError, match="not used"):
        load_settings(None, {"robot": {"device": "dry_run"}})


def test_a_device_is_imported_only_when_it_is_chosen():
    code = (
        "import sys; from robot_client.settings import load_settings;"
        "load_settings(None, {'robot': {'device': 'dry_run'}, 'gripper': {'device': 'dry_run'}}).make_arm();"
        "bad = [name for name in sys.modules if 'abb' in name or 'wsg50' in name or name in ('httpx', 'google')];"
        "sys.exit(str(bad) if bad else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("named", "robot", "gripper"),
    [
        ("robot is at 192.168.125.1", {"rws": {"url": "http://192.168.125.1"}}, "127.0.0.1"),
        ("robot is at 192.168.125.1", {"robot_host": "192.168.125.1"}, "127.0.0.1"),
        ("robot is at 192.168.125.1", {"device": "abb_rapid"}, "127.0.0.1"),
        ("gripper is at 192.168.1.20", {}, "192.168.1.20"),
    ],
)
def test_a_cell_whose_devices_are_elsewhere_is_not_a_simulated_one(named, robot, gripper):
    """A real cell's file that began as a copy of a simulated one's would need no commissioning, and not warn."""
    robot = {"rws": {"url": "http://127.0.0.1:1"}} | robot
    tables = {"robot": robot, "gripper": {"host": gripper}}
    with pytest.raises(SettingsError, match=f"simulated = true, but the {named}: .* remove the line"):
        load_settings(None, {"simulated": True, **tables})
    assert not load_settings(None, tables).simulated


def test_a_device_of_ones_own_is_in_a_simulated_cell_only_if_it_says_where_it_is(config):
    config.write_text("simulated = true\n" + CONFIG)
    with pytest.raises(SettingsError, match="simulated = true, but Settings of 'crane' have no hosts"):
        load_settings(config)
    here = "\n    @property\n    def hosts(self):\n        return ('127.0.0.1',)\n\nclass C"
    for name, driver in (("claw", GRIPPER), ("crane", ARM)):
        (config.parent / name / "driver.py").write_text(driver.replace("\nclass C", here, 1))
        sys.modules.pop(f"{name}.driver", None)
    assert load_settings(config).simulated
