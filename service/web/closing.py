"""How a WebSocket ends: its parallel parts stop together, the client is told why, and the log keeps it."""

import asyncio
import contextlib
from collections.abc import Coroutine
from dataclasses import dataclass
from typing import Any

import structlog
from fastapi import WebSocket, WebSocketDisconnect

NORMAL, GOING_AWAY, UNSUPPORTED, POLICY_VIOLATION, BROKEN, TRY_AGAIN_LATER = 1000, 1001, 1003, 1008, 1011, 1013
MAX_REASON_BYTES = 123  # what a close frame holds
CLOSE_S = 1.0  # for a close frame to a client that may not be reading any more
log = structlog.get_logger()


@dataclass(frozen=True, slots=True)
class Ending:
    """Why a conversation ends; ``code`` is one of RFC 6455; ``left``: the client is gone, there is nobody to tell."""

    code: int
    reason: str
    left: bool = False


async def until_one_ends(socket: WebSocket, *parts: Coroutine[Any, Any, Ending]) -> Ending:
    """Run all parts of a conversation until the first ends, then stop the others; the ending is the first one's.

    A part that raises anything but WebSocketDisconnect is logged, and told as 1011.
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
        return Ending(error.code, "the client left", left=True)
    log.error("connection broke", path=socket.url.path, error=repr(error))
    return Ending(BROKEN, f"internal error: {type(error).__name__}")


async def close(socket: WebSocket, ending: Ending) -> None:
    """Say goodbye with a reason; a client that is gone or does not read is not waited for."""
    if ending.left:
        return
    reason = ending.reason.encode()[:MAX_REASON_BYTES].decode(errors="ignore")
    with contextlib.suppress(RuntimeError, WebSocketDisconnect, TimeoutError):
        await asyncio.wait_for(socket.close(ending.code, reason), CLOSE_S)


async def until_gone(socket: WebSocket) -> Ending:
    """Ignore what a client says until it leaves; raises WebSocketDisconnect then."""
    while (event := await socket.receive())["type"] != "websocket.disconnect":
        pass
    raise WebSocketDisconnect(event.get("code", 1000))
