"""Checks of every request before its route: a rate per address, limits on its body, headers of the answer."""

import asyncio
import contextlib
import ipaddress
import time
from collections import OrderedDict
from collections.abc import AsyncIterator
from dataclasses import dataclass, field

from fastapi import HTTPException, Request
from fastapi.responses import JSONResponse
from starlette.datastructures import Headers
from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.web.access import Access

BODY_TIMEOUT_S = 15.0  # without a byte of an announced body
WHOLE_BODY_TIMEOUT_S = 60.0
BURST_S = 2.0  # an address may save up this much of its rate
MAX_ADDRESSES = 4096
MAX_BODY_BYTES = 32 << 20  # per request
MAX_BODIES_BYTES = 64 << 20  # of all requests held at once
IPV6_SITE_BITS = 64  # a subscriber's own part: a new address in it is no new peer
ALWAYS = {"/healthz", "/readyz", "/metrics", "/v2/health/live", "/v2/health/ready"}
INSERTION = {"/", "/v1/insertion"}
CONTENT_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self';"
    " base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HARDENED = {
    b"x-content-type-options": b"nosniff",
    b"content-security-policy": CONTENT_POLICY.encode(),
    b"x-frame-options": b"DENY",
    b"referrer-policy": b"no-referrer",  # an address may contain a token
    b"cross-origin-resource-policy": b"same-origin",
}
NO_STORING = b"cache-control", b"no-store"


@dataclass(slots=True)
class Rate:
    """A token bucket per peer: ``per_s`` events per second, 0 for no limit. One thread."""

    per_s: float
    _left: OrderedDict[str, tuple[float, float]] = field(default_factory=OrderedDict)

    def allows(self, peer: str, now_s: float | None = None) -> bool:
        """Count one event of a peer; False above the rate."""
        if not self.per_s:
            return True
        now_s = time.monotonic() if now_s is None else now_s
        most = max(1.0, self.per_s * BURST_S)
        left, last_s = self._left.pop(peer, (most, now_s))
        left = min(most, left + (now_s - last_s) * self.per_s)
        self._left[peer] = (left - 1 if left >= 1 else left, now_s)
        while len(self._left) > MAX_ADDRESSES:
            self._left.popitem(last=False)
        return left >= 1


class RequestLimits:
    """ASGI middleware: a rate per address, the declared length and a deadline of bodies, safe headers.

    Health checks and the insertion channel of clients that may drive are not counted: nobody can use up their share.
    """

    def __init__(self, app: ASGIApp, requests_per_s: float, access: Access) -> None:
        self._app, self._access = app, access
        self._rate = Rate(requests_per_s)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or answer 413 or 429."""
        kind = scope["type"]
        if kind not in {"http", "websocket"}:
            await self._app(scope, receive, send)
            return
        too_fast = not (self._reserved(scope) or self._rate.allows(peer_of(scope)))
        if too_fast:  # also before a WebSocket opens: closing it would be answered by 403, as a wrong token is
            text = f"more than {self._rate.per_s:g} requests a second; slow down"
            answer = JSONResponse({"error": text}, 429, {"Retry-After": "1", "Connection": "close"})
            await answer(scope, receive, hardened(send) if kind == "http" else send)
            return
        if kind == "websocket":
            await self._app(scope, receive, send)
            return
        send = hardened(send)
        if declared_bytes(scope) > MAX_BODY_BYTES:
            await JSONResponse({"error": _too_large(MAX_BODY_BYTES)}, 413)(scope, receive, send)
        else:
            await self._app(scope, timed(receive), send)

    def _reserved(self, scope: Scope) -> bool:
        path = scope["path"]
        if path in ALWAYS:
            return True
        driving = scope["type"] == "websocket" and path in INSERTION
        return driving and self._access.allows(HTTPConnection(scope), "drive")


def peer_of(scope: Scope) -> str:
    """The peer of a request: the address of its connection, which no header can change; the /64 prefix for IPv6."""
    host: str = (scope.get("client") or ("", 0))[0]
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return host
    if isinstance(address, ipaddress.IPv6Address):
        return str(address.ipv4_mapped or ipaddress.ip_network((address, IPV6_SITE_BITS), strict=False))
    return host


def declared_bytes(scope: Scope) -> int:
    """The body's length as declared by the request; 0 without one (the web server refuses an invalid number)."""
    return int(Headers(scope=scope).get("content-length") or 0)


def _too_large(most_bytes: int) -> str:
    return f"body larger than {most_bytes} bytes"


def timed(receive: Receive) -> Receive:
    """The same, but a body whose next piece takes longer than BODY_TIMEOUT_S is refused with 408."""
    whole = False

    async def next_piece() -> Message:
        nonlocal whole
        if whole:  # only the client's disconnection can follow
            return await receive()
        try:
            async with asyncio.timeout(BODY_TIMEOUT_S):
                message = await receive()
        except TimeoutError:
            raise HTTPException(408, f"no piece of the body for {BODY_TIMEOUT_S:g} s") from None
        whole = not message.get("more_body", False)
        return message

    return next_piece


@dataclass(slots=True)
class Bodies:
    """Total size of all bodies that the service holds at one moment."""

    most_bytes: int = MAX_BODIES_BYTES
    held_bytes: int = 0

    def take(self, bytes_n: int) -> None:
        """Reserve memory; raises HTTPException 429 if all of it is in use."""
        if self.held_bytes + bytes_n > self.most_bytes:
            text = f"{self.held_bytes >> 20} MiB of bodies are being read, at most {self.most_bytes >> 20} are"
            raise HTTPException(429, text, {"Retry-After": "1"})
        self.held_bytes += bytes_n


@contextlib.asynccontextmanager
async def whole_body(request: Request, most_bytes: int) -> AsyncIterator[bytearray]:
    """The body of a request, counted among the held ones until the context ends.

    Raises HTTPException 413 beyond ``most_bytes``, before reading if the request declares its length; 429 if the memory
    of all bodies is in use, 408 if it takes too long, and 400 if the client leaves meanwhile.
    """
    bodies: Bodies = request.app.state.bodies
    body, held_bytes = bytearray(), declared_bytes(request.scope)
    if held_bytes > most_bytes:
        raise HTTPException(413, _too_large(most_bytes))
    bodies.take(held_bytes)
    try:
        async for piece in _pieces(request):
            if len(body) + len(piece) > most_bytes:
                raise HTTPException(413, _too_large(most_bytes))
            more = max(0, len(body) + len(piece) - held_bytes)  # a chunked body declares no length
            bodies.take(more)
            held_bytes += more
            body += piece
        yield body
    finally:
        bodies.held_bytes -= held_bytes


async def _pieces(request: Request) -> AsyncIterator[bytes]:
    until_s = time.monotonic() + WHOLE_BODY_TIMEOUT_S
    more = True
    while more:
        message = await request.receive()
        if message["type"] == "http.disconnect":
            raise HTTPException(400, "the client left before its body was complete")
        if time.monotonic() > until_s:
            raise HTTPException(408, f"the body took longer than {WHOLE_BODY_TIMEOUT_S:g} s")
        more = message.get("more_body", False)
        yield message.get("body", b"")


def hardened(send: Send) -> Send:
    """The same with headers that keep browsers from guessing, caching, framing, and running foreign scripts."""

    async def send_on(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = [(name, value) for name, value in message.get("headers", ()) if name not in HARDENED]
            headers += HARDENED.items()
            if not any(name == NO_STORING[0] for name, _ in headers):
                headers.append(NO_STORING)
            message["headers"] = headers
        await send(message)

    return send_on
