"""Robot Web Services 2.0 of the emulated controller, as OmniCore with RobotWare 7 has them: what the client asks for.

The same cabinet as in generation 1.0 behind other addresses. Each route cites what it was written from: [L] the library
ros-industrial/abb_librws, folder v2_0; [P] addresses, bodies and recorded answers that users of controllers with
RobotWare 7.x have published.
"""

import base64
import json
import secrets
from collections.abc import Awaitable, Callable, Sequence

from fastapi import FastAPI, Request, Response
from starlette.middleware.base import BaseHTTPMiddleware

from simulation.cell.emulators.abb import rws_states
from simulation.cell.emulators.abb.cabinet import Cabinet, RefusedError
from simulation.cell.emulators.abb.rws import BAD_ARGUMENT, NOT_FOUND, Gate, execute, motors
from simulation.cell.emulators.abb.rws_format import DONE, REALM, State, _rows
from simulation.cell.emulators.abb.rws_more import form_of

HAL = "application/hal+json;v=2.0"
NO_MASTERSHIP = -1073445859  # [P] 403 of a write without it
SYSTEM = [State("sys-system", "system", {"major": "7", "minor": "10", "rwversion": "7.10.0", "name": "TactileCell"})]

Next = Callable[[Request], Awaitable[Response]]


def create_app2(cabinet: Cabinet, gate: Gate) -> FastAPI:
    """The web service of one controller; every handler runs on the event loop that advances the cabinet."""
    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)
    app.add_middleware(BaseHTTPMiddleware, dispatch=_versioned)
    app.add_middleware(BaseHTTPMiddleware, dispatch=gate)
    _add_states(app, cabinet)
    _add_orders(app, cabinet)

    async def refused(_request: Request, error: Exception) -> Response:
        code = error.code if isinstance(error, RefusedError) else BAD_ARGUMENT
        return _refusal(403 if isinstance(error, RefusedError) else 400, code, str(error))

    async def missing(request: Request, _error: Exception) -> Response:
        return _refusal(404, NOT_FOUND, f"no resource {request.url.path}")

    for kind in (ValueError, RefusedError):
        app.add_exception_handler(kind, refused)
    for missed in (KeyError, 404, 405):
        app.add_exception_handler(missed, missing)
    return app


def _answer(request: Request, states: list[State], *, listed: bool = False) -> Response:
    return Response(_as_hal(str(request.url.replace(query="")), states, listed=listed), media_type=HAL)


def _refusal(status: int, code: int, text: str) -> Response:
    body = _as_hal("", []).replace(b'"code": 294912', f'"code": {code}, "msg": "{text}"'.encode())
    return Response(body, status, media_type=HAL)


async def _versioned(request: Request, call_next: Next) -> Response:
    """[P] An Accept without v=2 is answered 406, a body without v=2 in its type 415; neither header is taken as 2.0."""
    accept, kind = request.headers.get("accept", "*/*"), request.headers.get("content-type", "v=2.0")
    if "*/*" not in accept and "v=2" not in accept:
        return _refusal(406, BAD_ARGUMENT, "Server cannot generate response for given accept header")
    if request.method == "POST" and "v=2" not in kind:
        return _refusal(415, BAD_ARGUMENT, f"content type {kind}, expected v=2.0 in it")
    return await call_next(request)


def _add_states(app: FastAPI, cabinet: Cabinet) -> None:
    @app.get("/rw")  # [P] asked without a password to tell the generation
    async def system(request: Request) -> Response:
        return _answer(request, SYSTEM)

    @app.get("/rw/panel/ctrl-state")  # [P]
    async def state(request: Request) -> Response:
        return _answer(request, rws_states.panel(cabinet, "ctrlstate"))

    @app.get("/rw/panel/opmode")  # [L], [P]; upper case
    async def mode(request: Request) -> Response:
        return _answer(request, rws_states.panel(cabinet, "opmode"))

    @app.get("/rw/panel/speedratio")  # [L] getSpeedRatio
    async def ratio(request: Request) -> Response:
        return _answer(request, rws_states.panel(cabinet, "speedratio"))

    @app.get("/rw/rapid/execution")  # [P] recorded: {"status", "state": [{"_type": "rap-execution", ...}]}
    async def execution(request: Request) -> Response:
        return _answer(request, rws_states.execution(cabinet))

    @app.get("/rw/iosystem/signals/{path:path}")  # [P] one signal comes as an embedded resource, too
    async def signal(request: Request, path: str) -> Response:
        return _answer(request, rws_states.signal(cabinet, path), listed=True)

    @app.get("/logout")  # [L]
    async def logout(request: Request) -> Response:
        return _answer(request, [])


def _add_orders(app: FastAPI, cabinet: Cabinet) -> None:
    @app.post("/rw/panel/ctrl-state")  # [P] body ctrl-state=motoron
    async def switch(request: Request) -> Response:
        motors(cabinet, await form_of(request))
        return Response(status_code=204)

    @app.post("/rw/rapid/execution/{action}")  # [L], [P]; start and resetpp need edit mastership, stop never does
    async def order(request: Request, action: str) -> Response:
        if action not in ("start", "stop", "resetpp"):
            raise KeyError(action)
        if action != "stop" and request.query_params.get("mastership") != "implicit":
            raise RefusedError("Operation rejected: mastership of the edit domain is needed", NO_MASTERSHIP)
        execute(cabinet, action, await form_of(request))
        return Response(status_code=204)

    @app.post("/rw/iosystem/signals/{path:path}/set-value")  # [P]
    async def set_signal(request: Request, path: str) -> Response:
        cabinet.set_signal(path.rsplit("/", 1)[-1], (await form_of(request)).get("lvalue", ""))
        return Response(status_code=204)


def _as_hal(base: str, states: Sequence[State], *, listed: bool = False) -> bytes:
    """JSON of generation 2.0: ``{"_links", "status", "state": [...]}``; of a list, the items as embedded resources."""
    inside = {"_embedded": {"resources": _rows(states)}} if listed else {"state": _rows(states)}
    return json.dumps({"_links": {"base": {"href": base}}, "status": {"code": DONE}} | inside).encode()


class Basic:
    """HTTP basic access for one user, as OmniCore asks for it."""

    def __init__(self, user: str, password: str) -> None:
        self._expected = base64.b64encode(f"{user}:{password}".encode()).decode()

    def challenge(self) -> str:
        """A ``WWW-Authenticate`` value."""
        return f'Basic realm="{REALM}"'

    def accepts(self, header: str | None, _method: str) -> bool:
        """True for the right user and password."""
        scheme, _, offered = (header or "").partition(" ")
        return scheme.lower() == "basic" and secrets.compare_digest(offered.strip().encode(), self._expected.encode())
