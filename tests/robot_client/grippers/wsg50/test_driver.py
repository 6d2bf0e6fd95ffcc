"""The driver against the emulated gripper, over a real socket: its requests, their order, and its reports."""

import asyncio
import contextlib
import itertools
from itertools import product

import pytest

from robot_client.grippers.wsg50.codes import GraspingState
from robot_client.grippers.wsg50.driver import Wsg50
from robot_client.grippers.wsg50.link import GripperError
from robot_client.grippers.wsg50.settings import Settings
from robot_client.insertion.events import Failure, Grasped, PartLost, Width
from simulation.cell.emulators.faults import FaultBoard
from simulation.cell.emulators.net import bind_tcp, port_of
from simulation.cell.emulators.wsg50 import Wsg50Emulator
from simulation.cell.emulators.wsg50_gripper import Gripper
from tests.robot_client.live_cell import Part
from tests.waiting import until


class Bench:
    def __init__(self, board, mechanism, emulator, driver):
        self.board, self.mechanism, self.emulator, self.driver = board, mechanism, emulator, driver
        self.events = asyncio.Queue()

    async def started(self):
        await self.driver.start(self.events.put_nowait)

    async def until(self, kind):
        """The next event of that kind."""
        while True:
            event = await asyncio.wait_for(self.events.get(), 20.0)
            if isinstance(event, kind):
                return event

    async def anew(self):
        """The next client of the gripper: it serves one at a time."""
        await self.driver.close()
        self.driver = Wsg50(self.driver.settings)

    @property
    def asked(self):
        """All but the queries of states, in order."""
        return self.emulator.counters.commands


@contextlib.asynccontextmanager
async def bench(*, present=True, holding=True, **settings):
    board, part = FaultBoard(), Part(present=present)
    mechanism = Gripper(part, board, holding=holding)
    mechanism.width_mm = min(mechanism.width_mm, 56.0)  # what is open is so by a little: no time is waited for
    emulator, sock = Wsg50Emulator(mechanism, board), bind_tcp(0, "gripper")
    await emulator.start(sock)
    made = Settings(
        host="127.0.0.1", port=port_of(sock), **{"grasp_speed_mm_s": 150.0, "reply_timeout_s": 20.0} | settings
    )
    cell = Bench(board, mechanism, emulator, Wsg50(made))
    try:
        async with asyncio.timeout(60.0):
            yield cell
    finally:
        await cell.driver.close()
        await emulator.stop()


async def test_what_is_held_is_accepted_as_it_is_and_left_as_it_was():
    async with bench() as cell:
        await cell.started()
        assert cell.driver.held
        cell.driver.grasp()
        grasped = await cell.until(Grasped)
    assert grasped.width_mm == 50.0
    assert cell.asked == ["SYSTEM_LIMITS", "DISCONNECT"]
    assert cell.mechanism.holding
    assert cell.emulator.counters.fast_stops_by_disconnect == 0, "it said that it leaves"


async def test_an_open_hand_closes_with_the_force_asked_for_and_is_watched():
    async with bench(holding=False, force_limit_n=25.0) as cell:
        await cell.started()
        assert not cell.driver.held
        cell.driver.grasp()
        grasped = await cell.until(Grasped)
    assert (grasped.width_mm, cell.mechanism.force_n, cell.driver.held) == (50.0, 25.0, True)
    assert cell.asked == ["SYSTEM_LIMITS", "SET_FORCE_LIMIT", "GRASP", "DISCONNECT"]


@pytest.mark.parametrize("holding", [True, False])
async def test_fingers_that_close_further_on_what_they_hold_are_reported(holding):
    async with bench(holding=holding) as cell:
        await cell.started()
        cell.driver.grasp()
        await cell.until(Grasped)
        cell.mechanism.width_mm = 48.0
        while (width := await cell.until(Width)).width_mm > 48.0:
            pass
    assert width.width_mm == 48.0


async def test_an_empty_place_is_named_as_such():
    async with bench(present=False, holding=False, grasp_width_mm=48.0) as cell:
        await cell.started()
        cell.driver.grasp()
        failure = await cell.until(Failure)
    assert (failure.code, failure.detail) == (
        "grasp",
        "gripper: closed to grasp_width_mm = 48 on nothing; is the object between the fingers?",
    )


async def test_what_is_held_is_let_go_of_by_a_release_and_open_fingers_move():
    async with bench() as cell:
        await cell.driver.connect()
        reached_mm, asked = [await cell.driver.release(54.0), await cell.driver.release(58.0)], cell.asked
    assert reached_mm == pytest.approx([54.0, 58.0], abs=0.01)
    assert asked == ["SYSTEM_LIMITS", "RELEASE", "MOVE"]


async def test_each_width_that_differs_by_a_tenth_is_reported():
    async with bench(holding=False, grasp_speed_mm_s=10.0) as cell:
        await cell.started()
        await cell.driver.release(60.0)
        widths = []
        while not cell.events.empty():
            widths.append(cell.events.get_nowait())
        widths = [event.width_mm for event in widths if isinstance(event, Width)]
    assert len(widths) > 2
    assert all(b - a >= 0.1 for a, b in itertools.pairwise(widths))
    assert (widths[0], widths[-1]) == (pytest.approx(56.0, abs=1.0), pytest.approx(60.0, abs=0.1))


@pytest.mark.parametrize(("present", "empty"), [(True, False), (False, True)])
async def test_closing_finds_nothing_only_where_nothing_is(present, empty):
    async with bench(present=present, holding=False, grasp_width_mm=48.0) as cell:
        await cell.started()
        nothing, state = await cell.driver.finds_nothing(), cell.mechanism.state
    assert (nothing, state) == (empty, GraspingState.NO_PART if empty else GraspingState.HOLDING)


REFUSED = {
    "opens too far": ({}, lambda driver: driver.release(111.0), "cannot open to 111 mm, this gripper allows 0 .. 110"),
    "opens no wider": ({}, lambda driver: driver.release(0.08), "to 0.08 mm, expected more than grasp_width_mm = "),
    "opens beyond closed": ({}, lambda driver: driver.release(-1.0), "cannot open to -1 mm"),
    "homes a part away": ({}, lambda driver: driver.home("outward"), "would drop it: open the fingers in its web page"),
    "too fast": ({"grasp_speed_mm_s": 421.0}, lambda driver: driver.finds_nothing(), "grasp_speed_mm_s = 421"),
    "opens too fast": ({"grasp_speed_mm_s": 421.0}, lambda driver: driver.release(55.0), "grasp_speed_mm_s = 421"),
    "too slow": ({"grasp_speed_mm_s": 4.9}, lambda driver: driver.finds_nothing(), "allows 5 .. 420"),
    "too hard": ({"force_limit_n": 81.0}, lambda driver: driver.finds_nothing(), "force_limit_n = 81"),
    "too wide": ({"grasp_width_mm": 111.0}, lambda driver: driver.finds_nothing(), "grasp_width_mm = 111"),
}


@pytest.mark.parametrize("name", REFUSED)
async def test_what_the_gripper_does_not_allow_is_refused_before_it_is_asked_for(name):
    settings, call, expected = REFUSED[name]
    async with bench(**settings) as cell:
        await cell.started()
        with pytest.raises(GripperError, match=expected):
            await call(cell.driver)
        assert not {"MOVE", "RELEASE", "GRASP", "HOMING"} & set(cell.asked)


async def test_fingers_that_are_not_homed_close_on_nothing_and_homing_says_where_they_are():
    async with bench(holding=False) as cell:
        cell.board.update({"gripper": {"not_homed": True}})
        await cell.started()
        with pytest.raises(GripperError, match="not homed; run"):
            await cell.driver.finds_nothing()
        await cell.anew()
        findings = await cell.driver.checks()["gripper"]()
        cell.board.update({"gripper": {"not_homed": False}})
        cell.mechanism.width_mm = 108.0
        width_mm = await cell.driver.home("outward")
    assert [good for good, _ in findings] == [True, False, *[True] * 5]
    assert width_mm == pytest.approx(110.0)


@pytest.mark.parametrize(("homed", "closes"), [(True, True), (False, False)])
async def test_fingers_close_before_homing_only_where_they_know_their_place(homed, closes):
    async with bench(present=False, holding=False) as cell:
        cell.board.update({"gripper": {"not_homed": not homed}})
        await cell.started()
        before_n = len(cell.emulator.counters.commands)
        await cell.driver.home("default")
        used = set(cell.emulator.counters.commands[before_n:])
    assert "HOMING" in used
    assert bool(used & {"GRASP", "MOVE"}) is closes


SHIPPED = {"force_limit_n": 40.0, "grasp_speed_mm_s": 150.0, "grasp_width_mm": 40.0}
ALLOWED = {"force_limit_n": "5 .. 80", "grasp_speed_mm_s": "5 .. 420", "grasp_width_mm": "0 .. 110"}


@pytest.mark.parametrize(
    ("name", "value", "good"),
    [
        *[("force_limit_n", value, value in (5.0, 80.0)) for value in (4.9, 5.0, 80.0, 80.1)],
        ("grasp_speed_mm_s", 421.0, False),
        ("grasp_width_mm", 111.0, False),
    ],
)
async def test_a_check_names_faults_settings_beyond_the_grippers_limits_state_and_width(name, value, good):
    async with bench(**{name: value}) as cell:
        findings = await cell.driver.checks()["gripper"]()
    values = SHIPPED | {name: value}
    own = [(good or key != name, f"{key} = {values[key]:g}, this gripper allows {ALLOWED[key]}") for key in SHIPPED]
    healthy = [(True, "no fault"), (True, "homed"), (True, "no temperature warning")]
    assert findings == [*healthy, *own, (True, "grasping state HOLDING, width 50.0 mm")]


async def test_a_latched_fault_is_named_and_only_the_operator_clears_it():
    async with bench() as cell:
        cell.mechanism.fast_stop()
        with pytest.raises(GripperError, match="fault FAST_STOP; find the cause"):
            await cell.started()
        orders = {
            "open": lambda driver: driver.release(55.0),
            "close": lambda driver: driver.finds_nothing(),
            "home": lambda driver: driver.home("default"),
        }
        for order in orders.values():
            with pytest.raises(GripperError, match="fault FAST_STOP; find the cause"):
                await order(cell.driver)
        await cell.anew()
        (fault, *_) = await cell.driver.checks()["gripper"]()
        await cell.driver.acknowledge()
        with pytest.raises(GripperError, match="holds a part; homing would drop it"):
            await cell.driver.home("default")
        await cell.anew()
        await cell.started()
    assert (fault.good, fault.text) == (False, "faults: FAST_STOP")


@pytest.mark.parametrize(
    ("fault", "kind", "code"),
    [
        ({"gripper": {"part_lost": True}}, PartLost, ""),
        ({"gripper": {"fast_stop": True}}, Failure, "error"),
        ({"wsg": {"reset_now": True}}, Failure, "link"),
        ({"wsg": {"silent": True}}, Failure, "silent"),
    ],
)
async def test_trouble_during_an_insertion_is_reported(fault, kind, code):
    async with bench(silence_s=0.2 if code == "silent" else 20.0) as cell:
        await cell.started()
        await cell.until(Width)
        assert cell.events.empty(), "fingers that rest are reported once"
        cell.board.update(fault)
        event = await cell.until((PartLost, Failure))
        cell.board.update({"wsg": {"silent": False}})
    assert isinstance(event, kind)
    assert getattr(event, "code", "") == code


async def test_a_close_that_is_cut_off_beside_a_silent_gripper_leaves_no_connection_open():
    async with bench() as cell:
        await cell.started()
        cell.board.update({"wsg": {"silent": True}})
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.1):
                await cell.driver.close()
        await until(lambda: cell.emulator.connection is None)


def test_each_change_of_the_grasping_state_means_what_it_says():
    quiet = {
        (before, after) for before, after in product(GraspingState, repeat=2) if before is not GraspingState.HOLDING
    }
    for before, after in product(GraspingState, repeat=2):
        driver, events = Wsg50(Settings()), []
        driver._on_state(float(before))
        driver._post = events.append
        driver._on_state(float(after))
        assert driver.state is after
        if before is after:
            assert events == []
        elif after is GraspingState.ERROR:
            assert [event.code for event in events] == ["error"]
            assert ("Part Width Tolerance" in events[0].detail) == (before is not GraspingState.HOLDING)
        elif (before, after) in quiet:
            assert events == []
        elif after in {GraspingState.PART_LOST, GraspingState.NO_PART}:
            assert [type(event) for event in events] == [PartLost]
        else:
            assert [event.code for event in events] == ["released"]


@pytest.mark.parametrize("value", [-1.0, 8.0, 2.5])
def test_a_grasping_state_that_is_none_is_a_fault_of_the_protocol(value):
    driver, events = Wsg50(Settings()), []
    driver._post = events.append
    driver._on_state(value)
    driver._on_state(value)
    assert [event.code for event in events] == ["protocol"], "reported once"
