"""Waiting for what another thread or process does, for as long as a busy machine may need."""

import asyncio
import time
from collections.abc import Callable
from typing import TypeVar

Answer = TypeVar("Answer")


def wait_for(holds: Callable[[], Answer], within_s: float = 60.0) -> Answer:
    """What ``holds`` gives as soon as that is true."""
    until_s = time.monotonic() + within_s
    while not (answer := holds()):
        assert time.monotonic() < until_s, f"not within {within_s:g} s"
        time.sleep(0.01)
    return answer


async def until(holds: Callable[[], object], every_s: float = 0.005) -> None:
    """Go on once that holds; 0: in the very turn of the event loop."""
    async with asyncio.timeout(60.0):
        while not holds():  # noqa: ASYNC110 nobody announces it
            await asyncio.sleep(every_s)
