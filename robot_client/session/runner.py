"""Carries out the commands of an insertion: owns the ports, the clock and the log; decides nothing."""

import asyncio
import contextlib
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Coroutine
from dataclasses import dataclass, field
from typing import Any, Protocol

from robot_client.insertion.events import (
    Arrived,
    Begin,
    Command,
    Event,
    Failure,
    Grasp,
    Hold,
    Move,
    Renew,
    Send,
    Source,
    Tick,
)
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.limits import LimitError, check_arrived
from robot_client.insertion.machine import step
from robot_client.insertion.state import Phase, Plan, State
from robot_client.interrupts import heed_interrupt, to_the_end, was_cancelled
from robot_client.ports import NOT_CONFIRMED, Arm, DecisionService, DriverError, Gripper
from robot_client.session.recorder import Recorder
from robot_client.session.telemetry import Telemetry
from service.contract import wire
from service.contract.refusals import reason

_TICK_S = 0.02
_PORTS: dict[str, Source] = {"grasp": "gripper", "say": "service"}  # to which an order goes, if not to the arm
CLOSING_S = 30.0  # a port that has not closed by then is left as it is


class Observer(Protocol):
    """Receives every event, for the terminal."""

    def on_event(self, state: State, event: Event) -> None:
        """``event`` happened; ``state`` is the one after it."""

    def summary(self) -> dict[str, Any]:
        """Its contribution to the log's last line: none, unless it has one."""
        return {}


async def farewell_of(arm: Arm) -> str:
    """How an arm's :meth:`Arm.close` ended; a driver that breaks, hangs or says nothing has confirmed nothing."""
    try:
        farewell = await asyncio.wait_for(arm.close(), CLOSING_S)
    except TimeoutError:
        return f"{NOT_CONFIRMED} (its driver has not closed within {CLOSING_S:g} s): use the stop button"
    except Exception as error:
        return f"{NOT_CONFIRMED} ({type(error).__name__} {error}): use the stop button"
    return farewell or f"{NOT_CONFIRMED} (its driver says nothing): use the stop button"


async def close_arm(arm: Arm, show: Callable[[str], None]) -> None:
    """Close an arm and show how that ended; raises DriverError if its stop was not confirmed."""
    farewell = await farewell_of(arm)
    show(farewell)
    if farewell.startswith(NOT_CONFIRMED):
        raise DriverError(f"robot: {farewell}")


async def close_gripper(closing: Coroutine[Any, Any, None], *, failed: bool = False) -> None:
    """Carry out the ``closing`` of a gripper to its end; raises DriverError if it breaks, or hangs for CLOSING_S.

    Where something has ``failed`` before, neither that nor an interrupt hides it.
    """
    try:
        await to_the_end(asyncio.wait_for(closing, CLOSING_S), interrupted=failed)
    except TimeoutError:
        if not failed:
            raise DriverError(f"gripper: its driver has not closed within {CLOSING_S:g} s") from None
    except Exception as error:
        if not failed:
            raise DriverError(f"gripper: its driver broke as it closed: {reason(error)}") from None


async def leave(*ports: Arm | Gripper | DecisionService) -> None:
    """Close ports of which nothing more is asked; one that breaks, or hangs for CLOSING_S, is left as it is."""
    for port in ports:
        with contextlib.suppress(Exception):
            await asyncio.wait_for(port.close(), CLOSING_S)


def _gives_up(error: Exception) -> Failure:
    """So that the arm holds, the service hears of it, and the log names the reason."""
    code, text = ("not_ready", "") if isinstance(error, DriverError) else ("broken", f"{type(error).__name__}: ")
    return Failure(at_s=time.monotonic(), source="client", code=code, detail=f"{text}{reason(error)}")


def _unless_broken(read: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What a driver gives; one that breaks on it hides neither the log's end nor how the arm was left."""
    try:
        return read()
    except Exception as error:
        return {"broken": f"{type(error).__name__} {error}"}


@contextlib.asynccontextmanager
async def closed_after(gripper: Gripper) -> AsyncIterator[Gripper]:
    """The gripper for a while; then it is closed, see :func:`close_gripper`."""
    failed = True
    try:
        yield gripper
        failed = False
    finally:
        await close_gripper(gripper.close(), failed=failed)


@dataclass(slots=True)
class Runner:
    """Runs one insertion to its end. Events are handled in order of arrival, commands at once, on one event loop."""

    plan: Plan
    arm: Arm
    gripper: Gripper
    service: DecisionService
    recorder: Recorder
    observers: tuple[Observer, ...] = ()
    simulated: bool | None = None  # the cell; for the recording
    state: State = field(init=False)
    farewell: str = ""
    _events: deque[Event] = field(default_factory=deque)
    _handling: bool = False
    _target: WorkPose | None = None  # of the move under way
    _done: asyncio.Event = field(default_factory=asyncio.Event)
    _greets: bool = False  # from the first message on
    _telemetry: Telemetry = field(init=False)

    def __post_init__(self) -> None:
        self.state = State(self.plan)
        self._telemetry = Telemetry(self.plan, self.arm, self.service.send, self.simulated)

    async def run(self) -> State:
        """From connecting to closing; raises DriverError if a device cannot be made ready (nothing has moved then).

        An interrupt ends the insertion like an operator's stop. During the closing it raises CancelledError, or
        DriverError if the arm's stop was not confirmed. Whatever else a driver raises comes out after the closing.
        """
        broken: Exception | None = None
        try:
            await self.service.start(self.post)
            await self.gripper.start(self.post)
            if not self.state.done:  # after a failure: no motors, no program
                pose = await self.arm.start(self.post)
                heed_interrupt()
                self.post(Begin(at_s=time.monotonic(), pose=pose, held=self.gripper.held))
            due_s = time.monotonic()
            while not self._done.is_set():
                due_s = max(due_s + _TICK_S, time.monotonic())
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._done.wait(), due_s - time.monotonic())
                self.post(Tick(at_s=time.monotonic()))
                self._telemetry.sample(self.state, self.state.width_mm)
        except asyncio.CancelledError:
            self.post(Failure(at_s=time.monotonic(), source="operator", code="stop", detail="interrupted"))
        except Exception as error:
            broken = error
            with contextlib.suppress(Exception):  # an observer may break on that, too
                self.post(_gives_up(error))
        finally:
            await to_the_end(self._close(), interrupted=True)
        if broken:
            raise DriverError(f"{reason(broken)}; robot: {self.farewell}") if self._may_move else broken
        if was_cancelled() and not self.state.reason.startswith("operator"):
            self.check_stopped()
            raise asyncio.CancelledError  # it ended in the same moment: nothing else may begin
        return self.state

    @property
    def _may_move(self) -> bool:
        return self.farewell.startswith(NOT_CONFIRMED)

    def check_stopped(self) -> None:
        """Raise DriverError if the arm's stop was not confirmed: nothing else may begin, and no finger open."""
        if self._may_move:
            raise DriverError(f"robot: {self.farewell}")

    def post(self, event: Event) -> None:
        """Handle an event now, or right after the one being handled. Called by the drivers on the event loop.

        One from the future bears another clock's time, after which no deadline would come: it fails. So does an arrival
        elsewhere than at the target.
        """
        if event.at_s > (now_s := time.monotonic()):
            detail = f"{event.kind} at {event.at_s:.3f} s, expected at most {now_s:.3f} s, of time.monotonic()"
            event = Failure(at_s=now_s, source="client", code="clock", detail=detail)
        elif isinstance(event, Arrived) and self._target is not None:
            try:
                check_arrived(self._target, event.pose)
            except LimitError as error:
                event = Failure(at_s=now_s, source="arm", code="tracking", detail=str(error))
        self._events.append(event)
        if self._handling:
            return
        self._handling = True
        try:
            while self._events:
                self._handle(self._events.popleft())
        finally:
            self._handling = False

    def _handle(self, event: Event) -> None:
        before = self.state
        self.state, commands = step(before, event)
        for command in commands:
            self._carry_out(command)
        if not isinstance(event, Tick) or self.state is not before:
            self.recorder.event(event)
        for command in commands:
            self.recorder.command(command)
        for observer in self.observers:
            with contextlib.suppress(OSError):  # a lost terminal must not end the task that brought the event
                observer.on_event(self.state, event)
        if self.state.done:
            self._done.set()

    def _carry_out(self, command: Command) -> None:
        try:
            match command:
                case Hold():
                    self._target = None
                    self.arm.hold(command.reason, stop=command.stop)
                case Move():
                    self._target = command.target
                    legs = (command.legs,) if command.legs else ()  # an arm with one speed need not support them
                    self.arm.move(command.target, command.motion, command.until_s, *legs)
                case Renew():
                    self.arm.renew(command.until_s)
                case Grasp():
                    self.gripper.grasp()
                case Send():
                    self._send(command.message)
        except LimitError as error:
            self._events.append(Failure(at_s=time.monotonic(), source="limits", code="move", detail=str(error)))
        except Exception as error:  # of the driver that got the order, not of the one whose event led to it
            source: Source = _PORTS.get(command.kind, "arm")
            detail = f"order {command.kind}: {type(error).__name__}: {error}"
            self._events.append(Failure(at_s=time.monotonic(), source=source, code="internal", detail=detail))

    def _send(self, message: wire.ClientMessage) -> None:
        """Send a message, between the robot's past motion and its next one.

        Before the greeting no insertion is open to be given up: an abort would be counted as a client refused.
        """
        self._greets = self._greets or isinstance(message, wire.ClientHello)
        if not self._greets:
            return
        if isinstance(message, wire.Stopped | wire.Abort):
            self._telemetry.flush()
        self.service.send(message)
        if isinstance(message, wire.ClientHello) and self.state.pose is not None:
            self._telemetry.begin(self.state.pose)

    async def _close(self) -> None:
        """The arm first: its program is stopped even if another port hangs."""
        self.farewell = await farewell_of(self.arm)
        await leave(self.service, self.gripper)
        self.recorder.end(self.summary())

    def link(self) -> dict[str, Any]:
        """The arm's figures."""
        return _unless_broken(self.arm.statistics)

    def rest(self) -> dict[str, Any]:
        """Where the arm was measured last; after the farewell: where it came to rest."""

        def measured() -> dict[str, Any]:
            here = self.arm.position()
            return {} if here is None else {name: round(value, 3) for name, value in here}

        return _unless_broken(measured)

    def summary(self) -> dict[str, Any]:
        return {
            "phase": str(self.state.phase),
            "inserted": self.state.phase is Phase.INSERTED,
            "attempts": self.state.attempt,
            "reason": self.state.reason,
            "controller": self.farewell,
            "rest": self.rest(),
            "link": self.link(),
            **{key: value for observer in self.observers for key, value in observer.summary().items()},
        }
