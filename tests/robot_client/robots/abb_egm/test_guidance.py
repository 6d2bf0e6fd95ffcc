"""Guidance datagram by datagram: the answers, the reports, and the causes of a permanent freeze."""

import asyncio
from types import SimpleNamespace

import pytest

from robot_client.insertion.events import Arrived, Failure, Standstill, Stood
from robot_client.insertion.geometry import CellFrame, WorkPose
from robot_client.insertion.lease import PAUSE_S
from robot_client.insertion.limits import LimitError, Limits
from robot_client.insertion.motion import Ramps
from robot_client.robots.abb_egm import codec
from robot_client.robots.abb_egm.driver import EgmArm
from robot_client.robots.abb_egm.settings import Settings
from tests.robot_client.live_cell import bench
from tests.robot_client.robots.abb_egm.test_driver import Wire

HERE = WorkPose(x_mm=5.0, y_mm=0.0, z_mm=60.0, yaw_deg=0.0)
CYCLE_MS = 4
LATER = SimpleNamespace(monotonic=lambda: 10.0, monotonic_ns=lambda: 10 * 10**9)  # than any silence that is allowed


class Controller:
    """Sends a datagram each cycle and lags behind the targets that come back."""

    def __init__(self, settings=None):
        self.arm, self.events = EgmArm(settings or Settings(), Limits(), Ramps()), []
        self.wire = Wire()
        self.arm._socket, self.arm._robot, self.arm._post = self.wire, ("127.0.0.1", 6510), self.events.append
        self.arm._timer = asyncio.get_running_loop().call_later(600.0, print)
        self.here, self.number, self.now_s, self.frame = HERE, 0, 0.0, CellFrame()

    def loses(self, count):
        self.number += count
        self.now_s += count * CYCLE_MS / 1000.0

    def cycles(self, count, late_s=0.0, **state):
        for _ in range(count):
            self.number += 1
            self.now_s += CYCLE_MS / 1000.0
            feedback = self.frame.to_controller(self.here)
            datagram = codec.encode_robot(codec.RobotState(self.number, CYCLE_MS * self.number, feedback, **state))
            self.arm._on_datagram(datagram, self.now_s + late_s)
            if self.wire.sent:
                target, _ = self.frame.from_controller(self.wire.sent[-1])
                self.here = self.here.towards(target, 0.2)

    @property
    def codes(self):
        return [event.code for event in self.events if isinstance(event, Failure)]


async def test_a_controller_that_is_not_ready_is_not_answered_and_the_reason_is_named():
    cell = Controller()
    cell.arm._timer.cancel()
    cell.cycles(3, motors_on=False)
    assert (cell.wire.sent, cell.arm._watch.not_ready) == ([], "the motors are off")
    cell.arm._on_datagram(b"nonsense", cell.now_s)
    assert "does not parse" in cell.arm._watch.not_ready
    assert not cell.arm._ready.is_set()
    with pytest.raises(LimitError, match="not started"):
        cell.arm.move(HERE, "travel")
    cell.cycles(2)
    assert len(cell.wire.sent) == 2
    assert cell.arm._ready.is_set()
    assert cell.arm.statistics()["bad_datagrams"] == 1


async def test_a_move_is_walked_and_its_arrival_reported_once():
    cell = Controller()
    cell.cycles(1)
    assert cell.arm.target() == HERE
    goal = WorkPose(x_mm=8.0, y_mm=-1.0, z_mm=55.0, yaw_deg=4.0)
    cell.arm.move(goal, "travel")
    cell.cycles(400)
    (arrived,) = cell.events
    assert isinstance(arrived, Arrived)
    assert arrived.pose.distance_mm(goal) < 0.05
    assert cell.arm.position().distance_mm(goal) < 0.05
    assert len(cell.wire.sent) == 401, "each datagram is answered"
    cell.arm._on_datagram(codec.encode_robot(codec.RobotState(3, 12, cell.wire.sent[-1])), cell.now_s)
    assert len(cell.wire.sent) == 401, "one that is out of order is not"


async def test_a_descent_stands_when_its_lease_ends_goes_on_when_it_is_renewed_and_holds_at_once():
    cell = Controller()
    cell.cycles(1)
    cell.arm.move(HERE.at_height(40.0), "descend", cell.now_s + 0.4)
    cell.cycles(110)
    stood = cell.arm.target()
    cell.cycles(5)
    assert cell.arm.target() == stood
    assert 57.0 < stood.z_mm < 59.0
    cell.arm.renew(cell.now_s + 5.0)
    cell.cycles(100)
    assert cell.arm.target().z_mm < stood.z_mm - 1.0
    before = len(cell.wire.sent)
    cell.arm.hold("slip", stop=False)
    assert len(cell.wire.sent) == before + 1, "the frozen target goes out at once"
    frozen = cell.arm.target()
    cell.cycles(60)
    (stands,) = cell.events
    assert isinstance(stands, Standstill)
    assert stands.still_s == pytest.approx(0.04)
    assert cell.arm.target() == frozen
    assert cell.arm.statistics()["pauses"] == 1
    cell.arm.move(HERE, "retract")


async def test_a_hold_answers_the_next_datagram_too_since_the_controller_takes_one_answer_a_cycle():
    """It queues the others: each hold would delay all later targets, and the stop of the next touch, by a cycle."""
    cell = Controller()
    cell.cycles(1)
    for height_mm in (59.5, 59.0, 58.5):
        cell.arm.move(HERE.at_height(height_mm), "descend", 9.0)
        cell.cycles(20)
        cell.arm.hold("slip", stop=False)
        cell.cycles(80)
    assert [type(event) for event in cell.events] == [Standstill] * 3
    assert len(cell.wire.sent) == cell.number


@pytest.mark.parametrize(("lost_n", "lasts_s"), [(1, 9.0), (8, 9.0), (40, 9.0), (55, 9.0), (40, 0.5)])
async def test_the_time_that_a_descent_loses_to_gaps_is_reported(lost_n, lasts_s):
    """By as much as its target is behind, to a few hundredths of a second; also where its lease ended in the gap."""
    cell = Controller()
    cell.cycles(1)
    until_s = cell.now_s + lasts_s
    cell.arm.move(HERE.at_height(40.0), "descend", until_s)
    cell.cycles(100)
    before_mm, since_s = cell.arm.target().z_mm, cell.now_s
    cell.loses(lost_n)
    cell.cycles(1)
    paused_s = max(0.0, cell.now_s - until_s)
    cell.arm.renew(cell.now_s + 9.0)
    cell.cycles(50)
    behind_s = cell.now_s - since_s - (before_mm - cell.arm.target().z_mm) / 5.0 - paused_s
    assert sum(event.stood_s for event in cell.events) == pytest.approx(behind_s, abs=0.05)
    assert bool(cell.events) == (behind_s > 0.05)
    assert {type(event) for event in cell.events} <= {Stood}


async def test_a_lease_that_nobody_renews_ends_the_descent_for_good():
    cell = Controller()
    cell.cycles(1)
    cell.arm.move(HERE.at_height(40.0), "descend", cell.now_s + 0.2)
    cell.cycles(round((0.2 + PAUSE_S) * 250) - 2)
    assert cell.codes == []
    cell.cycles(4)
    assert cell.codes == ["unwatched"]
    with pytest.raises(LimitError, match="takes no motion: unwatched"):
        cell.arm.move(HERE, "retract")


@pytest.mark.parametrize(("away_mm", "code"), [(9.9, []), (10.2, ["tracking"])])
async def test_an_arm_that_strays_from_its_target_is_held_where_it_is(away_mm, code):
    cell = Controller()
    cell.cycles(2)
    frozen = cell.arm.target()
    cell.here = HERE.model_copy(update={"y_mm": away_mm})
    before = len(cell.wire.sent)
    cell.cycles(1)
    assert cell.codes == code
    assert len(cell.wire.sent) == before + 1 + len(code), "frozen first, answered all the same"
    cell.cycles(5)
    assert cell.codes == code, "once"
    assert cell.arm.target() == frozen


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"motors_on": False}, "controller"),
        ({"collided": True}, "controller"),
        ({"late_s": 0.3}, "stale"),
        ({"late_s": 0.2}, None),
    ],
)
async def test_a_stream_that_is_no_longer_fit_freezes_the_arm_in_its_move(changes, code):
    cell = Controller()
    cell.cycles(2)
    cell.arm.move(HERE.at_height(45.0), "retract")
    cell.cycles(100)
    frozen = cell.arm.target()
    cell.cycles(20, **changes)
    assert cell.codes == ([code] if code else [])
    assert (cell.arm.target().distance_mm(frozen) < 0.3) == bool(code)


async def test_silence_is_noticed_by_the_watchdog_without_a_datagram(monkeypatch):
    class Time:
        monotonic = staticmethod(lambda: clock["now_s"])
        monotonic_ns = staticmethod(lambda: round(clock["now_s"] * 1e9))

    clock = {"now_s": 0.0}
    monkeypatch.setattr("robot_client.robots.abb_egm.driver.time", Time)
    cell = Controller()
    cell.cycles(5)
    codes = []
    for at_s in (0.05, 0.1, 0.15, 0.2, 0.26, 0.3):
        clock["now_s"] = at_s
        cell.arm._timer.cancel()
        cell.arm._watchdog()
        codes.append(list(cell.codes))
    assert codes == [[], [], [], [], [], ["silent"]]


async def test_an_arm_is_started_moved_held_and_its_program_stopped():
    async with asyncio.timeout(60.0), bench() as cell:
        arm, events = cell.settings.make_arm(), asyncio.Queue()
        # a busy machine makes gaps in the datagrams
        here = await arm.start(lambda event: isinstance(event, Stood) or events.put_nowait(event))
        arm.move(here.at_height(here.z_mm - 2.0), "descend", 1e9)
        arrived = await events.get()
        arm.hold("test", stop=False)
        stands = await events.get()
        statistics, findings = arm.statistics(), await arm.checks()["robot"]()
        assert cell.cabinet.running
        assert await arm.close() == "controller confirms: program stopped"
        assert not cell.cabinet.running
    assert (type(arrived), type(stands)) == (Arrived, Standstill)
    assert arrived.pose.z_mm == pytest.approx(38.0, abs=0.05)
    assert statistics["datagrams"] > 50
    assert statistics["worst_hold_us"] > 0
    assert statistics["worst_reply_us"] > 0
    assert findings[1].good


async def test_the_first_fault_alone_is_reported(monkeypatch):
    """An arm that has strayed falls silent, too, as when its program is stopped for it."""
    cell = Controller()
    cell.cycles(2)
    cell.here = HERE.model_copy(update={"y_mm": 15.0})
    cell.cycles(1)
    monkeypatch.setattr("robot_client.robots.abb_egm.driver.time", LATER)
    cell.arm._timer.cancel()
    cell.arm._watchdog()
    assert cell.codes == ["tracking"]
    with pytest.raises(LimitError, match="takes no motion: tracking"):
        cell.arm.move(HERE, "retract")


async def test_while_an_arm_is_closed_it_takes_no_motion_and_the_end_of_its_stream_is_no_fault(monkeypatch):
    """The controller may take seconds to confirm the stop, and is answered until then."""
    cell, confirmed = Controller(), asyncio.Event()
    cell.cycles(2)
    cell.wire.close = lambda: None
    monkeypatch.setattr(asyncio.get_running_loop(), "remove_reader", lambda _: None)
    cell.arm._stopping = asyncio.ensure_future(confirmed.wait())
    closing = asyncio.ensure_future(cell.arm.close())
    await asyncio.sleep(0)
    with pytest.raises(LimitError, match="takes no motion: closed"):
        cell.arm.move(HERE.at_height(40.0), "descend", cell.now_s + 5.0)
    cell.cycles(5)
    assert (len(cell.wire.sent), cell.arm.target()) == (7, HERE)
    with monkeypatch.context() as later:
        later.setattr("robot_client.robots.abb_egm.driver.time", LATER)
        cell.arm._timer.cancel()
        cell.arm._watchdog()
    confirmed.set()
    await closing
    assert cell.events == []


async def test_the_stream_is_looked_at_four_times_within_the_silence_that_is_allowed():
    cell = Controller()
    cell.cycles(1)
    cell.arm._timer.cancel()
    loop = asyncio.get_running_loop()
    cell.arm._watchdog()
    assert cell.arm._timer.when() - loop.time() == pytest.approx(0.25 / 4, abs=0.02)
