"""An operator's interrupt of what the client does: it breaks off no stop under way, and is never lost."""

import asyncio
from collections.abc import Coroutine
from typing import Any


async def to_the_end(work: Coroutine[Any, Any, None], *, interrupted: bool = False) -> None:
    """Carry out ``work`` to its end, because an interrupt must not break off a stop under way.

    Raises CancelledError afterwards if there was an interrupt, so that the caller moves nothing else; not if the caller
    was ``interrupted`` before and ends anyway.
    """
    task = asyncio.get_running_loop().create_task(work)
    interrupt = None
    while not task.done():
        try:
            await asyncio.shield(task)
        except asyncio.CancelledError as error:
            interrupt = error
    task.result()
    if interrupt and not interrupted:
        raise interrupt


def was_cancelled() -> bool:
    """Whether this task was interrupted, even where the interrupt came together with what it waited for."""
    task = asyncio.current_task()
    return task is not None and task.cancelling() > 0


def heed_interrupt() -> None:
    """Raise CancelledError if it :func:`was_cancelled`; after a driver that may have lost the interrupt."""
    if was_cancelled():
        raise asyncio.CancelledError
