"""The runner's guarantees for the arm in any circumstances: an orderly end, and no start after a failure."""

import asyncio
import time

import pytest

from robot_client.cli import jog
from robot_client.cli.terminal import printed
from robot_client.insertion.events import Arrived, Failure
from robot_client.insertion.state import Phase
from robot_client.ports import NOT_CONFIRMED, DriverError
from robot_client.session.recorder import Recorder
from robot_client.session.runner import Observer, Runner
from robot_client.session.travel import Errands
from robot_client.settings import Settings
from tests.robot_client.insertion.stories import PLAN, TO_ARMING


class Port:
    """Any of the three ports: notes its requests, in order, in a shared list."""

    held = False

    def __init__(self, name, notes, breaks="", farewell="controller confirms"):
        self.name, self.notes, self.breaks, self.farewell = name, notes, breaks, farewell
        self.closing = asyncio.Event()

    async def start(self, post):
        self.notes.append(f"start {self.name}")
        if self.breaks:
            post(Failure(at_s=0.0, source="gripper", code="link", detail=self.breaks))
        return TO_ARMING[0].pose

    def hold(self, _reason, *, stop):  # noqa: ARG002 the port's signature
        self.notes.append(f"hold {self.name}")

    def send(self, _message):
        pass

    def grasp(self):
        self.notes.append("grasp")

    def position(self):
        return None

    def target(self):
        return None

    def statistics(self):
        return {}

    async def close(self):
        self.notes.append(f"stopping {self.name}")
        await self.closing.wait()
        self.notes.append(f"stopped {self.name}")
        if not self.farewell:
            raise OSError("the controller is gone")
        return self.farewell


def runner(notes, observers=(), **breaks):
    arm, gripper, service = (Port(name, notes, breaks.get(name, "")) for name in ("arm", "gripper", "service"))
    return Runner(PLAN, arm, gripper, service, Recorder(None, PLAN), observers)


def let_close(run, *others):
    """The ports come to their end when they are asked to."""
    for port in (run.arm, run.service, run.gripper, *others):
        port.closing.set()


def way_of(arm, *corners):
    """A way outside an insertion, as its command begins it."""
    return lambda: Errands(lambda: arm, None, PLAN.limits, PLAN.ramps, 1.0, 35.0).go(lambda _here: [*corners])


def test_an_event_of_another_clock_ends_the_insertion_instead_of_its_deadlines():
    """As of a driver that stamps with time.time()."""
    notes = []
    run = runner(notes)
    run.post(TO_ARMING[0].model_copy(update={"at_s": time.time()}))
    assert run.state.phase is Phase.FAILED
    assert "client: clock: begin at" in run.state.reason
    assert notes == ["hold arm"]


async def test_an_operator_who_presses_twice_does_not_break_off_the_stop_that_the_first_press_asked_for():
    notes = []
    run = runner(notes)
    task = asyncio.ensure_future(run.run())
    await asyncio.sleep(0.05)
    for _ in range(3):
        task.cancel()
        await asyncio.sleep(0)
        await asyncio.sleep(0)
    let_close(run)
    state = await task
    assert notes[-6:] == [
        f"{word} {name}" for name in ("arm", "service", "gripper") for word in ("stopping", "stopped")
    ]
    assert (state.phase, run.farewell) == (Phase.FAILED, "controller confirms")


UNCONFIRMED = f"{NOT_CONFIRMED} by the controller: use the stop button"


@pytest.mark.parametrize("farewell", [UNCONFIRMED, ""])
@pytest.mark.parametrize("error", [None, DriverError("gripper: not homed"), OSError("no route"), ZeroDivisionError()])
@pytest.mark.parametrize("ends", ["start", "position", "statistics"])
async def test_an_arm_whose_stop_nobody_confirms_is_never_passed_over(ends, error, farewell):
    """Whatever else ended the insertion, an interrupt or a driver that breaks, and also where its farewell does."""

    async def not_ready(_post):
        raise error

    def breaks():
        raise error

    run = runner([], service="" if error else "gone")
    run.arm.farewell = farewell
    if error and ends == "start":
        run.gripper.start = not_ready
    elif error:
        run.arm.position = breaks
    if ends == "statistics":
        run.arm.statistics = lambda: 1 // 0
    task = asyncio.ensure_future(run.run())
    await asyncio.sleep(0.05)
    if not error:
        task.cancel()
    let_close(run)
    with pytest.raises(DriverError, match=r"STOP NOT CONFIRMED.*: use the stop button") as raised:
        await task
    assert (str(error or "") or "ZeroDivisionError") in str(raised.value) or not error


@pytest.mark.parametrize("moving", ["insertion", "way"])
async def test_an_interrupt_while_a_step_closes_by_itself_keeps_the_next_step_from_beginning(moving):
    notes = []
    run = runner(notes, service="gone")  # the insertion ends by itself
    arm = Port("arm", notes)
    arm.start = lambda _post: asyncio.sleep(0, PLAN.approach)
    steps = {"insertion": run.run, "way": way_of(arm)}
    task = asyncio.ensure_future(steps[moving]())
    await asyncio.sleep(0.05)
    assert notes[-1] == "stopping arm"
    task.cancel()
    let_close(run, arm)
    with pytest.raises(asyncio.CancelledError):
        await task
    assert "stopped arm" in notes


@pytest.mark.parametrize("moving", ["insertion", "way"])
async def test_an_interrupt_in_the_moment_in_which_a_step_ends_is_not_lost(moving):
    """`wait_for` returns what it has waited for, and forgets that the task was cancelled."""
    notes, moves = [], []
    run = runner(notes)
    arm = Port("arm", notes)
    let_close(run, arm)
    task = None

    def together(what):
        what()
        task.cancel()

    async def start(post):
        arm.post = post
        return PLAN.approach

    def move(target, _motion):
        moves.append(target)
        arrived = Arrived(at_s=0.0, pose=target)
        asyncio.get_running_loop().call_later(0.02, together, lambda: arm.post(arrived))

    arm.start, arm.move = start, move
    corners = (PLAN.approach, "travel"), (PLAN.approach.at_height(50.0), "travel")
    steps = {"insertion": run.run, "way": way_of(arm, *corners)}
    task = asyncio.ensure_future(steps[moving]())
    ended = Failure(at_s=0.0, source="service", code="link", detail="gone")
    if moving == "insertion":
        asyncio.get_running_loop().call_later(0.05, together, lambda: run.post(ended))
    with pytest.raises((asyncio.CancelledError, DriverError)):
        await task
    assert len(moves) == (moving == "way")
    assert any(note.startswith("stopped arm") for note in notes)


@pytest.mark.parametrize("moving", ["insertion", "way"])
async def test_an_interrupt_in_the_moment_in_which_the_arm_is_ready_moves_nothing(moving):
    notes, moves, task = [], [], None
    run = runner(notes)
    let_close(run)

    async def start(_post):
        ready = asyncio.Event()

        def together():
            ready.set()
            task.cancel()

        asyncio.get_running_loop().call_later(0.02, together)
        await asyncio.wait_for(ready.wait(), 1.0)
        return PLAN.approach

    run.arm.start, run.arm.move = start, lambda *way: moves.append(way)
    steps = {"insertion": run.run, "way": way_of(run.arm, (PLAN.approach, "travel"))}
    task = asyncio.ensure_future(steps[moving]())
    (ended,) = await asyncio.wait_for(asyncio.gather(task, return_exceptions=True), 2.0)
    assert isinstance(ended, DriverError) or ended.reason.startswith("operator")
    assert moves == []


@pytest.mark.parametrize("held_up", [True, False])
async def test_an_insertion_is_given_up_to_the_service_only_if_it_was_opened(held_up):
    """As by an interrupt while the motors are switched on: the service takes no first message but a greeting."""
    run, sent, waits = runner([]), [], asyncio.Event()
    let_close(run)
    run.service.send = lambda message: sent.append(message.type)

    async def start(_post):
        if held_up:
            await waits.wait()
        return TO_ARMING[0].pose

    run.arm.start = start
    task = asyncio.ensure_future(run.run())
    await asyncio.sleep(0.05)
    task.cancel()
    assert (await task).reason.startswith("operator")
    assert (sent[:1], "abort" in sent) == (([], False) if held_up else (["hello"], True))


async def test_no_program_is_started_once_a_device_has_failed():
    notes = []
    run = runner(notes, service="gone")
    let_close(run)
    state = await run.run()
    assert state.phase is Phase.FAILED
    assert "start arm" not in notes


class BrokenPipe(Observer):
    """A terminal without a reader."""

    def on_event(self, _state, _event):
        raise BrokenPipeError(32, "Broken pipe")


async def test_a_terminal_that_is_gone_ends_no_task_that_brings_events():
    run = runner([], observers=(BrokenPipe(),))
    for event in TO_ARMING[:2]:
        run.post(event)
    assert run.state.phase is Phase.GRASPING


async def test_a_jog_that_is_interrupted_stops_the_arm_and_says_so_in_one_line(monkeypatch, capsys):
    arm = Port("arm", [])
    arm.start = lambda _post: asyncio.Event().wait()
    monkeypatch.setattr(Settings, "make_arm", lambda _settings: arm)
    task = asyncio.ensure_future(jog._jog(Settings(), PLAN.approach))
    for _ in range(3):
        await asyncio.sleep(0)
        task.cancel()
    arm.closing.set()
    with pytest.raises(DriverError, match="interrupted"):
        await task
    printed()
    assert "controller confirms" in capsys.readouterr().out
