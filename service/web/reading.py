"""Reading recordings for those who look back, without taking the interpreter from the fingers' perception."""

import asyncio
import time
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from service.session.station import Station

REST = 4.0  # times as long as a read took the processor, while an insertion is under way
P = ParamSpec("P")
T = TypeVar("T")


class Reading:
    """Reads one recording at a time, and during an insertion takes a fifth of a processor at most.

    A read that waits for a slow disk leaves the interpreter to others, and needs no rest after it.
    """

    def __init__(self, station: Station) -> None:
        self._station, self._one = station, asyncio.Lock()

    async def __call__(self, read: Callable[P, T], *args: P.args, **options: P.kwargs) -> T:
        """The result of ``read``, which runs in a thread; raises what it raises."""
        async with self._one:
            spent_s = 0.0

            def measured() -> T:
                nonlocal spent_s
                began_s = time.thread_time()
                try:
                    return read(*args, **options)
                finally:
                    spent_s = time.thread_time() - began_s

            try:
                return await asyncio.to_thread(measured)
            finally:
                if self._station.active is not None:
                    await asyncio.sleep(REST * spent_s)
