"""Closing a WebSocket: its parallel parts stop together, and the client and the log get the reason."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Coroutine
from dataclasses import dataclass
from typing import Any

import structlog
from fastapi import WebSocket, WebSocketDisconnect

NORMAL, GOING_AWAY, UNSUPPORTED, POLICY_VIOLATION, BROKEN, TRY_AGAIN_LATER = 1000, 1001, 1003, 1008, 1011, 1013
RESTARTING = 1012  # by which the web server closes what is open when it stops
MAX_REASON_BYTES = 123  # capacity of a close frame
STREAM = "/stream.mjpg"  # end of the addresses whose answer ends with its reader only
CLOSE_S = 1.0  # for a close frame to a client that may have stopped reading
log = structlog.get_logger()


@dataclass(frozen=True, slots=True)
class Ending:
    """Why a conversation ends; ``code`` is one of RFC 6455; ``left``: the client has already left."""

    code: int
    reason: str
    left: bool = False


async def until_one_ends(socket: WebSocket, *parts: Coroutine[Any, Any, Ending]) -> Ending:
    """Run all parts of a conversation until the first one ends, then stop the others; returns the first one's ending.

    A part that raises anything but WebSocketDisconnect is logged, and sent as 1011.
    """
    tasks = [asyncio.create_task(part) for part in parts]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    first = next(task for task in tasks if task in done)
    error = first.exception()
    if error is None:
        return first.result()
    if isinstance(error, WebSocketDisconnect):
        return Ending(error.code, "the service stops" if error.code == RESTARTING else "the client left", left=True)
    log.error("connection broke", path=socket.url.path, error=repr(error))
    return Ending(BROKEN, f"internal error: {type(error).__name__}")


async def close(socket: WebSocket, ending: Ending) -> None:
    """Close with a reason, without waiting for a client that has left or does not read."""
    if ending.left:
        return
    reason = ending.reason.encode()[:MAX_REASON_BYTES].decode(errors="ignore")
    with contextlib.suppress(RuntimeError, WebSocketDisconnect, TimeoutError):
        await asyncio.wait_for(socket.close(ending.code, reason), CLOSE_S)


async def until_gone(socket: WebSocket) -> Ending:
    """Ignore messages until the client leaves; raises WebSocketDisconnect then."""
    while (event := await socket.receive())["type"] != "websocket.disconnect":
        pass
    raise WebSocketDisconnect(event.get("code", 1000))


@dataclass(slots=True)
class Slots:
    """Limit on the number of simultaneous clients of one kind."""

    most_n: int
    taken_n: int = 0

    @contextlib.asynccontextmanager
    async def taken(self, socket: WebSocket) -> AsyncIterator[bool]:
        """Take a slot for the duration of the context; if none is free, close with the reason and yield False."""
        if self.taken_n >= self.most_n:
            await close(
                socket, Ending(TRY_AGAIN_LATER, f"{self.most_n} such clients are connected, no more are served")
            )
            yield False
            return
        self.taken_n += 1
        try:
            yield True
        finally:
            self.taken_n -= 1
