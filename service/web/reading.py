"""Reading recordings for those who look back, without taking the interpreter from the fingers' perception."""

import asyncio
import time
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from service.session.station import Station

REST = 4.0  # times as long as a read took, while an insertion is under way
P = ParamSpec("P")
T = TypeVar("T")


class Reading:
    """Reads one recording at a time, and during an insertion for a fifth of the time at most."""

    def __init__(self, station: Station) -> None:
        self._station, self._one = station, asyncio.Lock()

    async def __call__(self, read: Callable[P, T], *args: P.args, **options: P.kwargs) -> T:
        """The result of ``read``, which runs in a thread; raises what it raises."""
        async with self._one:
            began_s = time.monotonic()
            try:
                return await asyncio.to_thread(read, *args, **options)
            finally:
                if self._station.active is not None:
                    await asyncio.sleep(REST * (time.monotonic() - began_s))
