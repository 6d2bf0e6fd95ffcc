"""Faults before the start are named, nothing moves, and a foreign program is never stopped."""

import asyncio
import math
import re
from dataclasses import replace

import pytest

from robot_client.ports import DriverError
from robot_client.robots.abb_rws.client import RwsClient
from robot_client.session.travel import straight_up
from robot_client.settings import SettingsError, load_settings
from service.contract import wire
from service.web.routes.insertion import HELLO_TIMEOUT_S
from simulation.cell.emulators.abb.motion import Pose
from tests.robot_client.live_cell import bench, outcome, side_by_side
from tests.waiting import until

MUTE_RWS = {
    "robot": {"rws": {"request_timeout_s": 0.3, "stop_timeout_s": 0.3}}
}  # only what never answers is given up soon
MUTE_EGM = {"robot": {"ready_timeout_s": 0.3}}
MUTE_GRIPPER = {"gripper": {"reply_timeout_s": 1.0}}  # as it ships: on a busy machine connecting alone may take 0.3 s
PATIENT = {"gripper": {"silence_s": 10.0}}  # a machine that stands still for a second is not what these are about


def board(**changes):
    return lambda cell: cell.board.update(changes)


def _answer(make):
    def prepare(cell):
        cell.service.on_message = lambda message: [make(message)] if isinstance(message, wire.ClientHello) else None

    return prepare


def _running(cell):
    cell.board.update({})
    cell.cabinet.state = "motoron"
    cell.cabinet.running = True


def _no_part(cell):
    cell.gripper._part.present = False


def _hello(**changes):
    limits = wire.Limits(max_dx_mm=15.0, max_dtheta_deg=15.0, max_frame_age_ms=250.0)
    values = {"models": (), "cameras": (), "controller": "belief", "limits": limits, **changes}
    return lambda message: wire.ServiceHello(insertion_id=message.insertion_id, **values)


LOST = wire.CameraEntry(finger="right", source="x", state="lost")
CASES = {
    "manual mode": (board(robot={"mode": "MANR"}), {}, "operating mode is MANR"),
    "protective stop": (board(robot={"protective_stop": True}), {}, "guardstop"),
    "emergency stop": (board(robot={"emergency_stop": True}), {}, "emergencystop"),
    "motors refused": (board(robot={"motors_off": True}), {}, "contactor"),
    "program runs already": (_running, {}, "runs already"),
    "rws down": (None, {"robot": {"rws": {"url": "http://127.0.0.1:9", "stop_timeout_s": 0.3}}}, "ConnectError"),
    "rws wrong password": (None, {"robot": {"rws": {"password": "guess"}}}, "HTTP 401"),
    "rws late": (board(rws={"delay_ms": 3000.0}), MUTE_RWS, "Timeout"),
    "rws garbage": (board(rws={"garbage_next": 50}), {}, "answer without"),
    "rws refuses": (board(rws={"refuse_next": 50}), {}, "HTTP 503"),
    "rws reset": (board(rws={"reset_next": 50}), {}, "GET /rw"),
    "egm silent": (board(egm={"silent": True}), MUTE_EGM, "no datagram came"),
    "egm garbage": (board(egm={"garbage_next": 100000}), MUTE_EGM, "EGM not ready"),
    "gripper down": (None, {"gripper": {"port": 9}}, "cannot connect"),
    "gripper silent": (board(wsg={"silent": True}), MUTE_GRIPPER, "no reply in time"),
    "gripper wrong crc": (board(wsg={"wrong_crc_next": 100000}), MUTE_GRIPPER, "no reply in time"),
    "gripper fast stop latched": (lambda cell: cell.gripper.fast_stop(), {}, "acknowledge"),
    "service down": (None, {"service": {"url": "ws://127.0.0.1:9"}}, "cannot connect"),
}
PHASES = {
    "gripper not homed": (board(gripper={"not_homed": True}), False, "not homed"),
    "no part": (_no_part, False, "grasp"),
    "service lost a camera": (_answer(_hello(cameras=(LOST,))), True, "camera of finger right is lost"),
    "service of another protocol": (_answer(_hello(protocol=9)), True, "protocol 9"),
}


async def _still(cell):
    await until(lambda: cell.trace)
    assert len({pose.position_mm for _, _, pose in cell.trace}) == 1, "the arm moved"


async def _refused(prepare, overrides):
    """Why a device that is not ready ends it before it begins, and whether a program runs afterwards."""
    async with bench(overrides=overrides) as cell:
        if prepare:
            prepare(cell)
        with pytest.raises(DriverError) as refusal:
            await cell.insert()
        await _still(cell)
        return str(refusal.value), cell.cabinet.running


async def _failed(prepare, holding):
    """The state in which an insertion ends that cannot begin."""
    async with bench(holding=holding, overrides=PATIENT) as cell:
        prepare(cell)
        state = await cell.insert()
        await _still(cell)
        return state


@pytest.fixture(scope="module")
def ended():
    """How each case ends."""
    stories = {name: _refused(prepare, overrides) for name, (prepare, overrides, _) in CASES.items()}
    return side_by_side(stories | {name: _failed(prepare, held) for name, (prepare, held, _) in PHASES.items()})


@pytest.mark.parametrize("name", CASES)
def test_a_device_that_is_not_ready_is_named_and_nothing_moves(name, ended):
    reason, running = outcome(ended, name)
    assert re.search(CASES[name][2], reason)
    assert running == (name == "program runs already"), "only our own program is stopped"


@pytest.mark.parametrize("name", PHASES)
def test_an_insertion_that_cannot_begin_says_why_and_moves_nothing(name, ended):
    state = outcome(ended, name)
    assert PHASES[name][2] in state.reason
    assert state.attempt == 0


async def test_a_stop_that_the_controller_ignores_is_reported_as_not_confirmed():
    async with bench(overrides={"robot": {"rws": {"stop_timeout_s": 0.3}}}) as cell:
        client = RwsClient(cell.settings.robot.rws)
        cell.board.update({"rws": {"stop_ignored": True}})
        await client.start_program()
        assert "NOT CONFIRMED" in await client.stop_program()
        await client.close()


async def test_an_errand_whose_stop_is_not_confirmed_says_so():
    async with bench(overrides={"robot": {"rws": {"stop_timeout_s": 0.3}}}) as cell:
        cell.board.update({"rws": {"stop_ignored": True}})
        with pytest.raises(DriverError, match=r"STOP NOT CONFIRMED .*: use the stop button"):
            await cell.settings.errands.go(straight_up(1.0))


async def test_a_stop_survives_refusals_and_cut_connections():
    async with bench() as cell:
        client = RwsClient(cell.settings.robot.rws)
        await client.start_program()
        cell.board.update({"rws": {"refuse_next": 2, "reset_next": 1, "garbage_next": 1}})
        assert "confirms" in await client.stop_program()
        assert not cell.cabinet.running
        await client.close()


@pytest.mark.parametrize("url", ["ftp://x", "no url", "http://"])
def test_an_rws_url_that_is_none_is_refused(url):
    with pytest.raises(SettingsError, match=r"rws\.url"):
        load_settings(None, {"robot": {"rws": {"url": url}}})


async def test_a_foreign_host_is_not_guided():
    async with bench(overrides={"robot": {"robot_host": "127.0.0.9", "ready_timeout_s": 0.3}}) as cell:
        with pytest.raises(DriverError, match=r"datagrams came, none from 127\.0\.0\.9"):
            await cell.insert()
        assert cell.egm.counters.received == 0
        await _still(cell)


def test_the_service_waits_for_a_hello_as_long_as_an_arm_may_take_to_be_guided():
    settings = load_settings(None)
    gripper_s = settings.gripper.reply_timeout_s * 5  # the connection, three questions, the first update
    motors_s = settings.robot.rws.motors_timeout_s + settings.robot.rws.start_timeout_s
    assert gripper_s + motors_s + settings.robot.ready_timeout_s < HELLO_TIMEOUT_S


@pytest.mark.parametrize("late", [False, True])
async def test_a_tool_that_leans_too_far_is_named_at_once_and_is_never_answered(late):
    """Without an answer the controller's program ends by itself, and says no more than that it does not run."""
    async with bench(overrides={"robot": {"rws": {"start_timeout_s": 0.5}}}) as cell:
        cell.cabinet.delays = replace(cell.cabinet.delays, communication_timeout_s=0.05)
        cell.cabinet.arm.pose = Pose((5.0, 0.0, 40.0), (0.0, math.cos(0.2), 0.0, math.sin(0.2)))
        cell.cabinet.arm.hold()
        if late:  # the web services answer only once it has ended
            cell.board.update({"rws": {"delay_ms": 200.0}})
        arm = cell.settings.make_arm()
        try:
            with pytest.raises(DriverError, match=r"the tool is tilted by 22\.92 deg, allowed 2; jog it upright"):
                await asyncio.wait_for(arm.start(lambda _event: None), 10.0)
            await until(lambda: not cell.cabinet.running)
        finally:
            await arm.close()
        assert cell.egm.counters.received == 0
        assert "EGM: communication with the guide timed out" in [entry.title for entry in cell.cabinet.log]


async def test_a_guide_that_never_answers_ends_the_controllers_program():
    """As the time-out of TactileEgm.mod."""
    async with bench() as cell:
        client = RwsClient(cell.settings.robot.rws)
        await client.start_program()
        await until(lambda: not cell.cabinet.running)
        await client.close()
