"""`doctor` against emulated devices: each fault is named in its place, with its own remedy."""

import asyncio
import contextlib
import os
import re
import socket
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from rich.console import Console

from robot_client.cli.alone import alone
from robot_client.cli.doctor import WIDTH, Row, doctor, examine, examine_pc, grid
from robot_client.cli.remedies import GENERAL, remedy_of
from robot_client.insertion.geometry import WorkPose
from robot_client.session.commission.record import Record, commissioned, keep_record, read_record
from robot_client.session.cycle import CycleSettings
from robot_client.session.handshake import HandshakeSettings
from robot_client.settings import _merged, load_settings
from service.contract import ContractError, wire
from service.contract.toml import toml_text
from tests.robot_client.live_cell import bench, outcome, side_by_side

SOON = {"robot": {"rws": {"request_timeout_s": 1.0}}, "gripper": {"reply_timeout_s": 0.5}}
SOON["service"] = {"connect_timeout_s": 1.0}


def with_(cell, **tables):
    """The cell's settings with other tables on top."""
    plain = cell.settings.model_dump(mode="json", exclude={"robot", "gripper"})
    devices = {key: getattr(cell.settings, key).model_dump(mode="json") for key in ("robot", "gripper")}
    devices["robot"]["rws"]["password"] = "robotics"
    cell.settings = load_settings(None, _merged(_merged({**plain, **devices}, SOON), tables))


def cameras(cell, left="live", right="live", rate_hz=None, doubt=""):
    states = (("left", left), ("right", right))
    entries = [
        wire.CameraEntry(finger=f, source="x", state=s, frame_rate_hz=rate_hz, gel_doubt=doubt) for f, s in states
    ]
    cell.service.hello = lambda **_: wire.ServiceHello(
        insertion_id="check", models=(), cameras=tuple(entries), controller="belief", limits=cell.service_limits
    )


OTHER_GEL = "this is not the gel that the camera was calibrated with"
SWAPPED = "it is the other finger's: the cameras are swapped, or one serves both fingers"


def dead_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def taken_port(cell):
    cell.taken = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    cell.taken.bind(("127.0.0.1", 0))
    with_(cell, robot={"port": cell.taken.getsockname()[1]})


def another_client(cell):
    cell.taken = contextlib.ExitStack()
    cell.taken.enter_context(alone(cell.settings))


def cycle(cell, pick_z_mm=45.0, plc=None):
    pick = WorkPose(x_mm=0.0, y_mm=0.0, z_mm=pick_z_mm, yaw_deg=0.0)
    cell.settings = cell.settings.model_copy(update={"cycle": CycleSettings(pick=pick, open_mm=80.0, plc=plc)})


def forget_token(cell):
    with_(cell, service={"token_file": "/nowhere/token"})


class Refusal(BaseHTTPRequestHandler):
    """A service answers so before a WebSocket is open if it does not know the token."""

    protocol_version = "HTTP/1.1"

    def do_GET(self):
        self.send_error(403)

    def log_message(self, *_):
        pass


def refused_token(cell):
    server = HTTPServer(("127.0.0.1", 0), Refusal)
    cell.taken = server.socket
    threading.Thread(target=server.handle_request, daemon=True).start()
    with_(cell, service={"url": f"ws://127.0.0.1:{server.server_port}/v1/insertion"})


def board(**faults):
    return lambda cell: cell.board.update(faults)


# name: (what is done to a healthy cell, where it must be found, words of the remedy)
FAULTS = {
    "manual mode": (board(robot={"mode": "MANR"}), "controller", "key switch"),
    "emergency stop": (board(robot={"emergency_stop": True}), "controller", "emergency stop"),
    "protective stop": (board(robot={"protective_stop": True}), "controller", "guard|protective"),
    "motors may not be switched on": (
        lambda cell: with_(cell, robot={"rws": {"switch_motors_on": False}}),
        "controller",
        "motors",
    ),
    "program runs already": (lambda cell: setattr(cell.cabinet, "running", True), "controller", "Stop the program"),
    "wrong password": (lambda cell: with_(cell, robot={"rws": {"password": "wrong"}}), "controller", "PASSWORD"),
    "wrong user": (lambda cell: with_(cell, robot={"rws": {"user": "nobody"}}), "controller", "user"),
    "no session left": (board(rws={"refuse_next": 50}), "controller", "session"),
    "controller answers late": (board(rws={"delay_ms": 3000.0}), "network", "rws.url"),
    "controller cuts connections": (board(rws={"reset_next": 50}), "*", "rws.url"),
    "no controller there": (
        lambda cell: with_(cell, robot={"rws": {"url": f"http://127.0.0.1:{dead_port()}"}}),
        "network",
        "rws.url",
    ),
    "unknown name of the controller": (
        lambda cell: with_(cell, robot={"rws": {"url": "http://no-such-robot.invalid"}}),
        "*",
        "address|rws.url",
    ),
    "plc signal missing": (lambda cell: cycle(cell, plc=HandshakeSettings()), "controller", "Define the signal"),
    "guidance port taken": (taken_port, "network", "UCdevice"),
    "another client is at work": (another_client, "gripper", "once that command has ended"),
    "gripper not homed": (board(gripper={"not_homed": True}), "gripper", "home --live"),
    "gripper too warm": (board(gripper={"temperature_warning": True}), "gripper", "cool"),
    "gripper fast stop": (lambda cell: cell.gripper.fast_stop(), "gripper", "--acknowledge"),
    "force beyond the gripper's": (
        lambda cell: with_(cell, gripper={"force_limit_n": 500.0}),
        "gripper",
        r"\[gripper\]",
    ),
    "no gripper there": (lambda cell: with_(cell, gripper={"port": dead_port()}), "network", "host and port"),
    "gripper silent": (board(wsg={"silent": True}), "gripper", "protocol"),
    "the controller's port for the gripper's": (
        lambda cell: with_(cell, gripper={"port": urlsplit(cell.settings.robot.rws.url).port}),
        "*",
        "host and port",
    ),
    "gripper refuses connections": (board(wsg={"refuse_connections": True}), "*", "protocol|host and port"),
    "left camera lost": (lambda cell: cameras(cell, left="lost"), "camera", "cable"),
    "right camera stalled": (lambda cell: cameras(cell, right="stalled"), "camera", "cable"),
    "camera never came up": (lambda cell: cameras(cell, left="starting"), "camera", "cable"),
    "cameras too slow for the descent": (lambda cell: cameras(cell, rate_hz=3.0), "camera", "ramp"),
    "cameras swapped": (
        lambda cell: cameras(cell, doubt=f"{OTHER_GEL}: {SWAPPED}"),
        "camera",
        "its own camera",
    ),
    "another gel": (lambda cell: cameras(cell, doubt=f"{OTHER_GEL}: is it another gel?"), "camera", "shade the gels"),
    "no token": (forget_token, "service", "token_file"),
    "another service's token": (refused_token, "service", "token_file"),
    "no service there": (
        lambda cell: with_(cell, service={"url": f"ws://127.0.0.1:{dead_port()}"}),
        "network",
        "serve",
    ),
    "approach outside the limits": (lambda cell: with_(cell, limits={"z_mm": [5.0, 30.0]}), "limits", "pose"),
    "full depth outside the limits": (lambda cell: with_(cell, limits={"z_mm": [34.0, 150.0]}), "limits", "pose"),
    "pick outside the limits": (lambda cell: cycle(cell, pick_z_mm=400.0), "limits", "pose"),
    "ramp beyond the limits": (
        lambda cell: with_(cell, ramps={"travel": {"speed_mm_s": 500.0, "acceleration_mm_s2": 1.0, "jerk_mm_s3": 1.0}}),
        "limits",
        "ramp",
    ),
}


async def findings_of(inject):
    async with bench() as cell:
        cell.service_limits = wire.Limits(max_dx_mm=15.0, max_dtheta_deg=15.0, max_frame_age_ms=250.0)
        with_(cell)
        inject(cell)
        await asyncio.sleep(0.1)
        try:
            return await examine(cell.settings)
        finally:
            if taken := getattr(cell, "taken", None):
                taken.close()


@pytest.fixture(scope="module")
def examined():
    """The rows of a healthy cell, and of one for each fault."""
    injected = {"healthy": lambda _cell: None} | {name: inject for name, (inject, _, _) in FAULTS.items()}
    return side_by_side({name: findings_of(inject) for name, inject in injected.items()})


def test_a_healthy_cell_has_nothing_wrong(examined):
    rows = outcome(examined, "healthy")
    assert [row for row in rows if not row.good] == []
    assert {row.area for row in rows} >= {"limits", "controller", "network", "gripper", "service"}


def test_devices_that_another_client_uses_are_left_to_it(examined):
    """A gripper takes one client: between two steps of a cycle, a second one would end it."""
    rows = outcome(examined, "another client is at work")
    assert not {row.area for row in rows if row.good} & {"controller", "network", "gripper"}
    assert {row.area for row in rows if row.good} >= {"limits", "service"}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_named_where_it_is_with_its_remedy(name, examined):
    _, area, words = FAULTS[name]
    wrong = [row for row in outcome(examined, name) if not row.good]
    assert wrong, f"{name}: nothing was found"
    named = [
        row for row in wrong if re.search(words, row.remedy) and row.area in {area, row.area if area == "*" else area}
    ]
    assert named, wrong
    assert all(row.remedy != GENERAL for row in wrong), wrong


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("gripper: SYSTEM_LIMITS: connection lost: [Errno 104] Connection reset by peer", "one client at a time"),
        ("http://10.0.0.1 is neither RWS 1.0 nor 2.0 (HTTP 200, ...); check robot.rws.url", "robot.rws.url"),
        ("robot: cannot listen on UDP 10.0.0.9:6510: [Errno 99] Cannot assign requested address", "robot.bind"),
        ("robot: cannot listen on UDP 0.0.0.0:6510: [Errno 98] Address already in use", "Another client"),
    ],
)
def test_what_another_device_says_has_no_remedy_of_the_service(text, words):
    assert words in remedy_of(text)


def test_a_pc_with_one_core_or_a_folder_that_cannot_be_written_is_named(tmp_path, monkeypatch):
    with monkeypatch.context() as small:
        small.setattr(os, "cpu_count", lambda: 1)
        wrong = [finding.text for finding in examine_pc(tmp_path) if not finding.good]
    assert any(text.startswith("1 processor cores") for text in wrong)
    file = tmp_path / "file"
    file.touch()
    assert any("not be written" in f.text for f in examine_pc(file) if not f.good)
    unreachable = tmp_path / ("x" * 300)  # as below a folder that this user may not enter: the system refuses to look
    assert not [f.text for f in examine_pc(unreachable) if "recordings" in f.text and not f.good]
    monkeypatch.setattr(os, "getloadavg", lambda: (99.0, 99.0, 99.0))
    (busy,) = [f.text for f in examine_pc(tmp_path) if f.text.startswith("load")]
    assert "two cores" not in remedy_of(busy)
    assert "busy" in remedy_of(busy)


def test_a_client_with_one_core_of_a_pc_that_has_more_is_as_documented(tmp_path, monkeypatch):
    """ROBOT_CPUSET=4 gives it that one, and the service others."""
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    allowed = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(allowed)})
        (cores,) = [finding for finding in examine_pc(tmp_path) if "processor cores" in finding.text]
    finally:
        os.sched_setaffinity(0, allowed)
    assert cores.good, cores


def test_a_wrong_configuration_is_a_row_like_any_other(tmp_path, capsys):
    config = tmp_path / "cell.toml"
    config.write_text("[task]\ngap_widht_mm = 56.0\n")
    for path, words in ((config, "Correct that key"), (Path("/nowhere.toml"), "--config")):
        outcome = doctor(path, {}, tmp_path)
        assert not outcome.done
        assert any(words in row["remedy"] for row in outcome.result["rows"])
    shown = capsys.readouterr().out
    assert "gap_widht_mm" in shown.replace("\n", "")
    assert max(len(line) for line in shown.splitlines()) <= WIDTH


def test_the_table_fits_a_terminal_and_shows_texts_as_they_are(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    rows = [Row("gripper", False, "fault [bold]FAST_STOP[/] \x1b[2J " + "word " * 40, "do " * 60)]
    Console(width=WIDTH).print(grid(rows))
    text = capsys.readouterr().out
    assert max(len(line) for line in text.splitlines()) <= WIDTH
    assert "\x1b" not in text
    assert "[bold]" in text


def test_a_record_of_another_version_is_renewed_by_commissioning(tmp_path):
    path = tmp_path / "commissioning.toml"
    path.write_text('{"version": 1, "begun": "then", "seed": 1}')
    with pytest.raises(ContractError) as refused:
        read_record(path)
    assert "commission --live" in remedy_of(str(refused.value))
    path.write_text(toml_text(Record(begun="then", seed=1).model_dump()))
    with pytest.raises(ContractError) as edited:
        read_record(path)
    assert "commission --live" in remedy_of(str(edited.value))
    keep_record(path, Record(begun="then", seed=1))
    with pytest.raises(ContractError) as cut_off:
        commissioned(path)
    assert "commission --live" in remedy_of(str(cut_off.value))
