"""What a person orders while the client asks the PLC counts before the next part begins, and no request is lost."""

import asyncio
from types import SimpleNamespace

import pytest

from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.state import Phase, State
from robot_client.ports import DriverError
from robot_client.session.cycle import Cycle, CycleHeldError, CycleSettings
from robot_client.session.handshake import Handshake, HandshakeSettings
from tests.robot_client.insertion.stories import PLAN

TAUGHT = CycleSettings(pick=WorkPose(x_mm=0.0, y_mm=0.0, z_mm=45.0, yaw_deg=0.0), open_mm=80.0)


@pytest.mark.parametrize(
    ("reason", "carried"),
    [
        ("client: attempts: the last attempt, number 15, was blocked", True),
        ("service: no_decision: low_confidence: d", True),
        ("service: refused: turned_in_hand: by 1.4 deg", True),
        ("service: refused: nothing_held: d", True),
        ("service: refused: implausible_width: d", True),
        ("service: refused: no_reference: no frame pair arrived", False),
        ("service: refused: untrained: gap_width_mm is 56", False),
        ("service: non_finite: the networks failed", False),
        ("service: contradictory: d", False),
        ("arm: tracking: d", False),
    ],
)
async def test_a_part_is_carried_away_only_where_the_fault_is_its_own(reason, carried):
    ways, reject = [], WorkPose(x_mm=20.0, y_mm=0.0, z_mm=45.0, yaw_deg=0.0)

    async def go(way):
        ways.append(way)

    async def with_gripper(work):
        return await work(SimpleNamespace(held=False, release=release, width_mm=width_mm, finds_nothing=finds_nothing))

    async def release(width_mm):
        return width_mm

    async def width_mm():
        return TAUGHT.open_mm

    async def finds_nothing():
        return False

    async def insert(_number):
        if cycle.count.rejected_n:
            return State(PLAN, phase=Phase.FAILED, reason="operator: stop: d")
        return State(PLAN, phase=Phase.FAILED, reason=reason)

    errands = SimpleNamespace(go=go, with_gripper=with_gripper, clear_mm=35.0)
    cycle = Cycle(TAUGHT.model_copy(update={"reject": reject}), errands, insert, lambda _text: None)
    with pytest.raises(CycleHeldError):
        await cycle.run(None)
    assert (cycle.count.rejected_n, len(ways)) == ((1, 4) if carried else (0, 1))


class Signals:
    """A PLC whose start comes on as it is read; a person orders something in the same moment."""

    def __init__(self, order):
        self.order, self.reads_n = order, 0

    async def read_signal(self, name):
        self.reads_n += name == "diTactileStart"
        if self.reads_n == 3:
            self.order()
        return self.reads_n >= 3

    async def write_signal(self, name, *, on):
        pass

    async def close(self):
        pass


@pytest.mark.parametrize("word", ["pause", "stop"])
async def test_no_part_is_picked_after_an_order_that_came_together_with_the_plcs_start(word):
    went = []

    async def go(way):
        went.append(way)

    async def is_empty(_work):
        return True

    signals = Signals(lambda: cycle.pace.order(word))
    errands = SimpleNamespace(go=go, with_gripper=is_empty)
    cycle = Cycle(TAUGHT, errands, None, lambda _text: None, plc=Handshake(HandshakeSettings(), signals))
    task = asyncio.ensure_future(cycle.run(None))
    await asyncio.wait({task}, timeout=2.0)
    assert signals.reads_n >= 3
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    assert went == []


class LostController(Signals):
    """Signals of a controller that answers no more once it is lost."""

    lost = False

    async def write_signal(self, _name, *, on):  # noqa: ARG002 the port's signature
        if self.lost:
            raise DriverError("POST /rw/iosystem/signals: ConnectError")


async def test_a_controller_that_answers_no_more_does_not_hide_why_the_cycle_ended():
    async def is_empty(_work):
        return True

    async def insert(_number):
        signals.lost = True
        raise DriverError("arm: silent: no new datagram for 300 ms")

    errands = SimpleNamespace(go=lambda _way: asyncio.sleep(0), with_gripper=is_empty, clear_mm=35.0)
    signals, lines = LostController(lambda: None), []
    cycle = Cycle(TAUGHT, errands, insert, lines.append, plc=Handshake(HandshakeSettings(), signals))
    with pytest.raises(DriverError, match="arm: silent"):
        await cycle.run(None)
    assert lines[-1].startswith("the PLC may not know of the fault: POST")


async def test_an_interrupt_while_the_plc_is_told_of_a_fault_does_not_hide_why_the_cycle_ended():
    """With its controller gone the client waits there for seconds: it must not say in the end that nothing moves."""
    signals, answers, waits = LostController(lambda: None), asyncio.Event(), asyncio.Event()

    async def is_empty(_work):
        return True

    async def insert(_number):
        signals.write_signal = wait
        raise DriverError("robot: STOP NOT CONFIRMED by the controller (no answer): use the stop button")

    async def wait(_name, *, on):
        waits.set()
        await answers.wait()

    errands = SimpleNamespace(go=lambda _way: asyncio.sleep(0), with_gripper=is_empty, clear_mm=35.0)
    cycle = Cycle(TAUGHT, errands, insert, lambda _text: None, plc=Handshake(HandshakeSettings(), signals))
    task = asyncio.ensure_future(cycle.run(None))
    await asyncio.wait_for(waits.wait(), 5.0)
    task.cancel()
    await asyncio.sleep(0)
    answers.set()
    with pytest.raises(DriverError, match="STOP NOT CONFIRMED"):
        await task


class Levels:
    """The signals as the controller keeps them, and a PLC that acts ``in_part``."""

    def __init__(self, in_part=lambda _levels: None):
        self.levels = dict.fromkeys(("diTactileStart", "doTactileReady", "doTactileDone", "doTactileFault"), False)
        self.in_part, self.parts_n = in_part, 0
        self.cycle = None

    async def read_signal(self, name):
        return self.levels[name]

    async def write_signal(self, name, *, on):
        self.levels[name] = on

    async def close(self):
        pass

    def run(self):
        """The cycle as a task; each part is inserted at once."""

        async def insert(_number):
            self.parts_n += 1
            self.in_part(self.levels)
            return SimpleNamespace(phase=Phase.INSERTED, attempt=1)

        async def is_so(_work):
            return True

        errands = SimpleNamespace(go=lambda _way: asyncio.sleep(0), with_gripper=is_so, clear_mm=35.0)
        self.cycle = Cycle(TAUGHT, errands, insert, lambda _text: None, plc=Handshake(HandshakeSettings(), self))
        return asyncio.ensure_future(self.cycle.run(1))

    async def offered(self):
        """A running cycle that is ready for a part."""
        running = self.run()
        await self.until(Ready=True)
        return running

    async def until(self, **expected):
        async with asyncio.timeout(5.0):
            while any(self.levels[f"doTactile{name}"] != on for name, on in expected.items()):  # noqa: ASYNC110
                await asyncio.sleep(0.01)


async def test_a_part_that_was_requested_before_a_pause_is_begun_after_it():
    plc = Levels()
    running = await plc.offered()
    plc.cycle.pace.order("pause")
    plc.levels["diTactileStart"] = True
    await plc.until(Ready=False)
    await asyncio.sleep(0.5)
    assert plc.parts_n == 0
    plc.cycle.pace.order("resume")
    await plc.until(Done=True)
    plc.levels["diTactileStart"] = False
    await running
    assert plc.parts_n == 1


async def test_a_part_that_is_requested_in_a_pause_is_a_fault_and_moves_nothing():
    plc = Levels()
    running = await plc.offered()
    plc.cycle.pace.order("pause")
    await plc.until(Ready=False)
    await asyncio.sleep(0.5)
    plc.levels["diTactileStart"] = True
    plc.cycle.pace.order("resume")
    with pytest.raises(DriverError, match="diTactileStart is on before doTactileReady; look whether"):
        await running
    assert (plc.parts_n, plc.levels["doTactileFault"]) == (0, True)


async def test_a_plc_whose_request_a_person_has_stopped_is_told_by_a_fault():
    plc = Levels()
    running = await plc.offered()
    plc.cycle.pace.order("stop")
    plc.levels["diTactileStart"] = True
    with pytest.raises(CycleHeldError, match="the part that the PLC requests was not begun"):
        await running
    assert (plc.parts_n, plc.levels["doTactileReady"], plc.levels["doTactileFault"]) == (0, False, True)


async def test_a_plc_that_took_its_request_back_cannot_miss_that_the_part_is_done():
    plc = Levels(lambda levels: levels.update(diTactileStart=False))  # as one that was restarted
    running = await plc.offered()
    plc.levels["diTactileStart"] = True
    with pytest.raises(DriverError, match="see that the PLC does not ask for it again"):
        await running
    assert (plc.parts_n, plc.levels["doTactileDone"], plc.levels["doTactileFault"]) == (1, True, True)
