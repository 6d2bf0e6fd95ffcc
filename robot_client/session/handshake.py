"""The handshake of a cycle with a PLC, over digital signals of the robot's controller.

Levels, not pulses, so that neither side can miss one::

    client: ready 1 -> PLC: start 1 -> client: ready 0, one part, done 1 (or fault 1) -> PLC: start 0 -> client: done 0

A start that comes before ready, or goes off before done, is a fault: one side would take a part for another.
``fault`` stays on: the cycle has ended, and a person has to restart it. A PLC pauses a cycle by keeping ``start`` off.
"""

import asyncio
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

from pydantic import Field

from robot_client.ports import DriverError, Signals
from service.contract.frames import Contract

NAME = r"^[A-Za-z][A-Za-z0-9_/.-]{0,80}$"
POLL_S = 0.1
LOST_S = 3.0  # answers that are lost for so long, while nothing is under way, end no cycle
_Answer = TypeVar("_Answer")


class HandshakeSettings(Contract):
    """Names of the controller's signals: ``start`` is an input that the PLC writes, the others are outputs."""

    start: str = Field(default="diTactileStart", pattern=NAME)
    ready: str = Field(default="doTactileReady", pattern=NAME)
    done: str = Field(default="doTactileDone", pattern=NAME)
    fault: str = Field(default="doTactileFault", pattern=NAME)
    release_timeout_s: float = Field(default=30.0, gt=0)


@dataclass(slots=True)
class Handshake:
    """One side of the handshake; every method raises DriverError if a signal cannot be read or written."""

    settings: HandshakeSettings
    signals: Signals
    _offered: bool = False  # a start counts

    async def begin(self) -> None:
        """Switch the outputs off; a PLC that already requests a start is refused, since the client was not ready."""
        names = self.settings
        for name in (names.ready, names.done, names.fault):
            await self.signals.write_signal(name, on=False)
        await self._check_off(self._requested)

    async def asked(self, *, ready: bool) -> bool:
        """Signal whether the client is ready, and return whether the PLC requests a part.

        A request that came before ready went off still counts: the PLC takes that part to be under way. Raises
        DriverError if the PLC requests one that nobody was ready for.
        """
        if ready and not self._offered:
            await self._check_off(self._requested_yet)
        self._offered = self._offered or ready
        await _patiently(partial(self.signals.write_signal, self.settings.ready, on=ready))
        await asyncio.sleep(POLL_S)
        requested = self._offered and await self._requested_yet()
        self._offered = ready or requested
        return requested

    async def busy(self) -> None:
        self._offered = False
        await self.signals.write_signal(self.settings.ready, on=False)

    async def done(self) -> None:
        """Signal done and wait until the PLC has seen it; raises DriverError if it cannot have, or does not in time."""
        names = self.settings
        kept = await self._requested()
        await self.signals.write_signal(names.done, on=True)
        if not kept:
            look = "the part is done, see that the PLC does not ask for it again, then start the cycle"
            raise DriverError(f"plc: {names.start} went off before {names.done}; {look}")
        try:
            async with asyncio.timeout(names.release_timeout_s):
                while await self._requested():  # noqa: ASYNC110 a device tells only if asked
                    await asyncio.sleep(POLL_S)
        except TimeoutError:
            late = f"{names.start} is still on {names.release_timeout_s:g} s after {names.done}"
            raise DriverError(f"plc: {late}; switch it off, then start the cycle") from None
        await self.signals.write_signal(names.done, on=False)

    async def _requested(self) -> bool:
        return await self.signals.read_signal(self.settings.start)

    async def _requested_yet(self) -> bool:
        return await _patiently(self._requested)

    async def _check_off(self, requested: Callable[[], Awaitable[bool]]) -> None:
        if await requested():
            names = self.settings
            look = "look whether the last part is in, switch it off, then start the cycle"
            raise DriverError(f"plc: {names.start} is on before {names.ready}; {look}")

    async def end(self, *, fault: bool) -> None:
        """Clear ready and, after a failure, set fault; then close the connection."""
        try:
            await self.busy()
            if fault:
                await self.signals.write_signal(self.settings.fault, on=True)
        finally:
            await self.signals.close()


async def _patiently(ask: Callable[[], Awaitable[_Answer]]) -> _Answer:
    """Ask again where an answer is lost: a level may be read and written any number of times."""
    until_s = time.monotonic() + LOST_S
    while True:
        try:
            return await ask()
        except DriverError:
            if time.monotonic() >= until_s:
                raise
        await asyncio.sleep(POLL_S)
