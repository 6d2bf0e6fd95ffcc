"""The way of an inference request past the router: the same checks, the same function, none of the search for it.

Matching a path against every route and resolving its parameters costs several times what the small networks take.
"""

import re

from fastapi import HTTPException, Request
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException as AnyHTTPException
from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Receive, Scope, Send

from service.contract import ContractError
from service.web.access import Access
from service.web.routes.oip import VERSION, Packed, Served

INFER = re.compile(r"/v2/models/([^/]+)(?:/versions/([^/]+))?/infer")


class Shortcut:
    """ASGI middleware in front of the router, which describes these routes and would answer them alike."""

    def __init__(self, app: ASGIApp, served: Served, access: Access) -> None:
        self._app, self._served, self._access = app, served, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer an inference request, pass anything else on."""
        found = INFER.fullmatch(scope["path"]) if scope["type"] == "http" and scope["method"] == "POST" else None
        if found is None:
            await self._app(scope, receive, send)
            return
        request = Request(scope, receive)
        try:
            self._access.check(request, "drive")
            answer = await self._served.infer(request, found[1], found[2] or VERSION)
        except (ContractError, HTTPException) as error:
            answer = refusal(error)
        await answer(scope, receive, send)

    def answer_now(self, scope: Scope, headers: dict[str, str], body: bytes) -> Packed | None:
        """The answer to a request whose body is here already; None where it takes longer or has to be refused."""
        found = INFER.fullmatch(scope["path"])
        if found is None or scope["method"] != "POST":
            return None
        try:
            self._access.check(HTTPConnection(scope), "drive")
        except HTTPException:
            return None
        return self._served.infer_now(found[1], found[2] or VERSION, headers, body)


def refusal(error: ContractError | AnyHTTPException) -> JSONResponse:
    """Every refusal is ``{"error": ...}``, under /v1 as under /v2."""
    if isinstance(error, AnyHTTPException):
        return JSONResponse({"error": str(error.detail)}, error.status_code, error.headers)
    return JSONResponse({"error": str(error)}, 400)
