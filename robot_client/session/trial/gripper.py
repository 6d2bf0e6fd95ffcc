"""Try a gripper's driver: with an empty hand it closes and opens, with a part it holds one until a person pulls it out.

Each finding shows whether one promise of the port :class:`Gripper` is kept.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable

from robot_client.insertion.events import Event, Failure, Grasped, PartLost, Width
from robot_client.interrupts import heed_interrupt
from robot_client.ports import DriverError, Finding, Gripper
from robot_client.session.runner import closed_after

MOVED_MM = 1.0  # fingers that have moved report more, fingers that have not report less
ALONE_S = 1.0  # by then a gripper that lets go without a client has begun to
PULL_S = 30.0
Make = Callable[[], Gripper]
Show = Callable[[Finding], None]


async def try_empty(make: Make, grasping_s: float, show: Show) -> None:
    """Close the open, empty fingers twice and open them again; raises DriverError if the gripper is not ready."""
    open_mm = await _open_mm(make)
    async with _watching(make) as (gripper, events):
        gripper.grasp()
        widths_mm, event = await _next(events, grasping_s)
        show(Finding(isinstance(event, Failure), f"grasp of nothing: {_text(event)}, expected a failure"))
        show(_moved("width events", open_mm, min(widths_mm, default=open_mm)))
    async with _connected(make) as gripper:
        await gripper.release(open_mm)
        show(_unmoved("release", open_mm, await gripper.width_mm()))
        empty = await gripper.finds_nothing()
        show(Finding(empty and not gripper.held, f"finds_nothing: {empty}, held: {gripper.held}, expected True, False"))
        show(_moved("width_mm", open_mm, await gripper.width_mm()))
        await gripper.release(open_mm)


async def try_part(make: Make, grasping_s: float, show: Show, ask: Callable[[str], None]) -> None:
    """Hold the part between the open fingers, also without a client, and lose it; raises DriverError as above."""
    open_mm = await _open_mm(make)
    async with _watching(make) as (gripper, events):
        grasped = await _grasp(gripper, events, grasping_s, show)
        show(_moved("grasped", open_mm, grasped.width_mm))
    await asyncio.sleep(ALONE_S)
    async with _connected(make) as gripper:
        show(_unmoved("close", grasped.width_mm, await gripper.width_mm()))
        empty = await gripper.finds_nothing()
        show(Finding(not empty, f"close: finds_nothing afterwards: {empty}, expected False"))
    async with _watching(make) as (gripper, events):
        await _grasp(gripper, events, grasping_s, show)
        ask(f"pull the part out of the fingers, within {PULL_S:g} s")
        _, event = await _next(events, PULL_S)
        show(Finding(isinstance(event, PartLost), f"pulled out: {_text(event)}, expected part_lost"))


@contextlib.asynccontextmanager
async def _connected(make: Make) -> AsyncIterator[Gripper]:
    async with closed_after(make()) as gripper:
        await gripper.connect()
        heed_interrupt()
        yield gripper


@contextlib.asynccontextmanager
async def _watching(make: Make) -> AsyncIterator[tuple[Gripper, asyncio.Queue[Event]]]:
    events = asyncio.Queue[Event]()
    async with closed_after(make()) as gripper:
        await gripper.start(events.put_nowait)
        heed_interrupt()
        yield gripper, events


async def _open_mm(make: Make) -> float:
    async with _connected(make) as gripper:
        open_mm = await gripper.width_mm() - 0.5 * MOVED_MM  # fingers at their stop can open no further
    if not open_mm > MOVED_MM:
        raise DriverError(f"width_mm: the fingers are {open_mm:.1f} mm apart, expected open ones")
    return open_mm


async def _grasp(gripper: Gripper, events: asyncio.Queue[Event], within_s: float, show: Show) -> Grasped:
    gripper.grasp()
    _, event = await _next(events, within_s)
    if not isinstance(event, Grasped):
        raise DriverError(f"grasp: {_text(event)}, expected grasped")
    show(Finding(gripper.held, f"grasp: grasped at {event.width_mm:.1f} mm, held: {gripper.held}, expected True"))
    return event


async def _next(events: asyncio.Queue[Event], within_s: float) -> tuple[list[float], Event | None]:
    """The next event but for widths, None if there is none in time; and the widths before it, mm."""
    widths_mm: list[float] = []
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(within_s):
            while isinstance(event := await events.get(), Width):
                widths_mm.append(event.width_mm)
            return widths_mm, event
    return widths_mm, None


def _moved(name: str, open_mm: float, closed_mm: float) -> Finding:
    least = f"expected more than {MOVED_MM:g} mm less"
    return Finding(open_mm - closed_mm > MOVED_MM, f"{name}: {open_mm:.1f} mm open, {closed_mm:.1f} mm closed, {least}")


def _unmoved(name: str, before_mm: float, after_mm: float) -> Finding:
    text = f"{name}: {before_mm:.1f} mm expected, {after_mm:.1f} mm measured, allowed {MOVED_MM:g} mm apart"
    return Finding(abs(after_mm - before_mm) <= MOVED_MM, text)


def _text(event: Event | None) -> str:
    if event is None:
        return "no event in time"
    return f"failure {event.code}: {event.detail}" if isinstance(event, Failure) else event.kind
