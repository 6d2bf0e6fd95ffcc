"""What every request passes before its route: a rate per client, a deadline for its body, headers of the answer."""

import asyncio
import time
from collections import OrderedDict
from dataclasses import dataclass, field

from fastapi import HTTPException, Request
from fastapi.responses import JSONResponse
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

BODY_TIMEOUT_S = 15.0  # without a byte of a body that was announced
BURST_S = 2.0  # a client may save up this much of its rate
MAX_CLIENTS = 4096
NO_GUESSING, NO_STORING = (b"x-content-type-options", b"nosniff"), (b"cache-control", b"no-store")
ALWAYS = {"/healthz", "/readyz", "/metrics", "/v2/health/live", "/v2/health/ready"}


@dataclass(slots=True)
class Rate:
    """A token bucket a client: ``per_s`` events a second, 0 for no limit. One thread."""

    per_s: float
    _left: OrderedDict[str, tuple[float, float]] = field(default_factory=OrderedDict)

    def allows(self, client: str, now_s: float | None = None) -> bool:
        """Count one event of a client; False if it comes too fast."""
        if not self.per_s:
            return True
        now_s = time.monotonic() if now_s is None else now_s
        most = max(1.0, self.per_s * BURST_S)
        left, last_s = self._left.pop(client, (most, now_s))
        left = min(most, left + (now_s - last_s) * self.per_s)
        self._left[client] = (left - 1 if left >= 1 else left, now_s)
        while len(self._left) > MAX_CLIENTS:
            self._left.popitem(last=False)
        return left >= 1


class RequestLimits:
    """ASGI middleware: a rate per client (an address with its token), a deadline for bodies, safe headers."""

    def __init__(self, app: ASGIApp, requests_per_s: float) -> None:
        self._app = app
        self._rate = Rate(requests_per_s)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or answer 429."""
        kind = scope["type"]
        if kind not in {"http", "websocket"}:
            await self._app(scope, receive, send)
            return
        too_fast = scope["path"] not in ALWAYS and not self._rate.allows(client_of(scope))
        if too_fast and kind == "http":
            text = f"more than {self._rate.per_s:g} requests a second; slow down"
            await JSONResponse({"error": text}, 429, {"Retry-After": "1"})(scope, receive, send)
        elif too_fast:
            await send({"type": "websocket.close", "code": 1013, "reason": "too many connections a second"})
        elif kind == "http":
            await self._app(scope, timed(receive), hardened(send))
        else:
            await self._app(scope, receive, send)


def client_of(scope: Scope) -> str:
    """Who asks: address and token."""
    host = (scope.get("client") or ("", 0))[0]
    return f"{host} {Headers(scope=scope).get('authorization', '')[:200]}"


def timed(receive: Receive) -> Receive:
    """The same, but a body whose next piece takes longer than BODY_TIMEOUT_S is refused with 408."""
    whole = False

    async def next_piece() -> Message:
        nonlocal whole
        if whole:  # what follows is only the news that the client left
            return await receive()
        try:
            async with asyncio.timeout(BODY_TIMEOUT_S):
                message = await receive()
        except TimeoutError:
            raise HTTPException(408, f"no piece of the body for {BODY_TIMEOUT_S:g} s") from None
        whole = not message.get("more_body", False)
        return message

    return next_piece


async def whole_body(request: Request, most_bytes: int) -> bytes:
    """The body of a request, bounded; raises HTTPException 413 beyond that and 400 if the client leaves meanwhile."""
    body = bytearray()
    while True:
        message = await request.receive()
        if message["type"] == "http.disconnect":
            raise HTTPException(400, "the client left before its body was complete")
        piece: bytes = message.get("body", b"")
        if len(body) + len(piece) > most_bytes:
            raise HTTPException(413, f"body larger than {most_bytes} bytes")
        if not message.get("more_body", False):
            return bytes(body + piece) if body else piece
        body += piece


def hardened(send: Send) -> Send:
    """The same with headers that keep browsers from guessing and caching."""

    async def send_on(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = [(name, value) for name, value in message.get("headers", ()) if name != NO_GUESSING[0]]
            headers.append(NO_GUESSING)
            if not any(name == NO_STORING[0] for name, _ in headers):
                headers.append(NO_STORING)
            message["headers"] = headers
        await send(message)

    return send_on
