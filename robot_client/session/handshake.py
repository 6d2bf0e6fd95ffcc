"""The handshake of a cycle with a PLC, over digital signals of the robot's controller.

Levels, not pulses, so that neither side can miss one::

    client: ready 1 -> PLC: start 1 -> client: ready 0, one part, done 1 (or fault 1) -> PLC: start 0 -> client: done 0

``fault`` stays on: the cycle has ended, and a person has to restart it. A PLC pauses a cycle by keeping ``start`` off.
"""

import asyncio
from dataclasses import dataclass

from pydantic import Field

from robot_client.ports import DriverError, Signals
from service.contract.frames import Contract

NAME = r"^[A-Za-z][A-Za-z0-9_/.-]{0,80}$"
POLL_S = 0.1


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

    async def begin(self) -> None:
        """Switch the outputs off; a PLC that already requests a start is refused, since the client was not ready."""
        names = self.settings
        for name in (names.ready, names.done, names.fault):
            await self.signals.write_signal(name, on=False)
        if await self.signals.read_signal(names.start):
            raise DriverError(f"plc: {names.start} is on before {names.ready}; switch it off, then start the cycle")

    async def asked(self) -> bool:
        """Signal ready, and return whether the PLC requests a part now."""
        await self.signals.write_signal(self.settings.ready, on=True)
        await asyncio.sleep(POLL_S)
        return await self.signals.read_signal(self.settings.start)

    async def busy(self) -> None:
        await self.signals.write_signal(self.settings.ready, on=False)

    async def done(self) -> None:
        """Signal done and wait until the PLC has seen it; raises DriverError if it does not within the time."""
        names = self.settings
        await self.signals.write_signal(names.done, on=True)
        try:
            async with asyncio.timeout(names.release_timeout_s):
                while await self.signals.read_signal(names.start):  # noqa: ASYNC110 a device tells only if asked
                    await asyncio.sleep(POLL_S)
        except TimeoutError:
            text = f"plc: {names.start} is still on {names.release_timeout_s:g} s after {names.done}"
            raise DriverError(text) from None
        await self.signals.write_signal(names.done, on=False)

    async def end(self, *, fault: bool) -> None:
        """Clear ready and, after a failure, set fault; then close the connection."""
        try:
            await self.busy()
            if fault:
                await self.signals.write_signal(self.settings.fault, on=True)
        finally:
            await self.signals.close()
