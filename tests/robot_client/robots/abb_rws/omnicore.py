"""Robot Web Services 2.0 of the emulated controller, as OmniCore with RobotWare 7 has them: what this cell needs.

The same cabinet as in generation 1.0 behind other addresses. Each route cites what it was written from: [L] the library
ros-industrial/abb_librws, folder v2_0; [P] addresses, bodies and recorded answers that users of controllers with
RobotWare 7.x have published; [D] ABB's reference of 1.0 (3HAC050973-001), where 2.0 is told to be the same.
"""

import base64
import json
import secrets
from collections.abc import Awaitable, Callable, Sequence

from fastapi import FastAPI, Request, Response
from starlette.middleware.base import BaseHTTPMiddleware

from simulation.cell.emulators.abb import rws_states
from simulation.cell.emulators.abb.cabinet import Cabinet, RefusedError
from simulation.cell.emulators.abb.frames import CellFrames
from simulation.cell.emulators.abb.rws import BAD_ARGUMENT, NOT_FOUND, Gate, execute, motors, speed_ratio
from simulation.cell.emulators.abb.rws_format import DONE, REALM, State, _rows, as_xhtml
from simulation.cell.emulators.abb.rws_more import add_core, form_of, modules
from simulation.cell.emulators.abb.rws_subscriptions import add_subscriptions

PROTOCOL = "rws_subscription"  # [L], [P]
HAL, XHTML = "application/hal+json;v=2.0", "application/xhtml+xml;v=2.0"
NO_MASTERSHIP = -1073445859  # [P] 403 of a write without it
DOMAINS = ("edit", "motion")  # [L] MastershipDomain
SYSTEM = [
    State("sys-system", "system", {"major": "7", "minor": "10", "rwversion": "7.10.0", "name": "TactileCell"}),
    State("sys-options", "options", {"option": "3124-1 Externally Guided Motion (EGM)"}),
]

Next = Callable[[Request], Awaitable[Response]]


def create_app2(cabinet: Cabinet, frames: CellFrames, gate: Gate) -> FastAPI:
    """The web service of one controller; every handler runs on the event loop that advances the cabinet."""
    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)
    app.add_middleware(BaseHTTPMiddleware, dispatch=_versioned)
    app.add_middleware(BaseHTTPMiddleware, dispatch=gate)
    held: dict[str, str] = {}
    _add_panel(app, cabinet, held)
    _add_rapid(app, cabinet, held)
    _add_symbols(app, cabinet, held)
    _add_motion_and_signals(app, cabinet, frames)
    _add_mastership(app, held)
    add_core(app, _listed, XHTML)  # [D]
    add_subscriptions(app, cabinet, gate.admits, PROTOCOL)

    async def refused(request: Request, error: Exception) -> Response:
        code = error.code if isinstance(error, RefusedError) else BAD_ARGUMENT
        return _refusal(request, 403 if isinstance(error, RefusedError) else 400, code, str(error))

    async def missing(request: Request, _error: Exception) -> Response:
        return _refusal(request, 404, NOT_FOUND, f"no resource {request.url.path}")

    for kind in (ValueError, RefusedError):
        app.add_exception_handler(kind, refused)
    for missed in (KeyError, 404, 405):
        app.add_exception_handler(missed, missing)
    return app


def _wants_json(request: Request) -> bool:
    return "hal+json" in request.headers.get("accept", "")


def _answer(request: Request, states: list[State], *, listed: bool = False) -> Response:
    base = str(request.url.replace(query=""))
    if _wants_json(request):
        return Response(_as_hal(base, states, listed=listed), media_type=HAL)
    return Response(as_xhtml(base, states), media_type=XHTML)


def _listed(request: Request, states: list[State]) -> Response:
    return _answer(request, states, listed=True)


def _refusal(request: Request, status: int, code: int, text: str) -> Response:
    states = [State("status", "error", {"code": code, "msg": text})]
    if not _wants_json(request):
        return Response(as_xhtml("", states), status, media_type=XHTML)
    body = _as_hal("", []).replace(b'"code": 294912', f'"code": {code}, "msg": "{text}"'.encode())
    return Response(body, status, media_type=HAL)


async def _versioned(request: Request, call_next: Next) -> Response:
    """[P] An Accept without v=2 is answered 406, a body without v=2 in its type 415; neither header is taken as 2.0."""
    accept, kind = request.headers.get("accept", "*/*"), request.headers.get("content-type", "v=2.0")
    if "*/*" not in accept and "v=2" not in accept:
        return _refusal(request, 406, BAD_ARGUMENT, "Server cannot generate response for given accept header")
    if request.method in {"POST", "PUT"} and "v=2" not in kind:
        return _refusal(request, 415, BAD_ARGUMENT, f"content type {kind}, expected v=2.0 in it")
    return await call_next(request)


def _done() -> Response:
    return Response(status_code=204)


def _needs_edit(request: Request, held: dict[str, str]) -> None:
    """Raise RefusedError unless this session holds the edit domain, or asks for it with the request ([L] implicit)."""
    mine = held.get("edit") == request.cookies.get("ABBCX") and "edit" in held
    if not mine and ("edit" in held or request.query_params.get("mastership") != "implicit"):
        raise RefusedError("Operation rejected: mastership of the edit domain is needed", NO_MASTERSHIP)


def _add_panel(app: FastAPI, cabinet: Cabinet, held: dict[str, str]) -> None:
    @app.get("/rw")  # [P] asked without a password to tell the generation
    @app.get("/rw/system")  # [L] getRobotWareSystem
    async def system(request: Request) -> Response:
        return _answer(request, SYSTEM)

    @app.get("/rw/panel/ctrl-state")  # [P]
    async def state(request: Request) -> Response:
        return _answer(request, rws_states.panel(cabinet, "ctrlstate"))

    @app.post("/rw/panel/ctrl-state")  # [P] body ctrl-state=motoron
    async def switch(request: Request) -> Response:
        motors(cabinet, await form_of(request))
        return _done()

    @app.get("/rw/panel/opmode")  # [L], [P]; upper case
    async def mode(request: Request) -> Response:
        return _answer(request, rws_states.panel(cabinet, "opmode"))

    @app.get("/rw/panel/speedratio")  # [L] getSpeedRatio
    async def ratio(request: Request) -> Response:
        return _answer(request, rws_states.panel(cabinet, "speedratio"))

    @app.post("/rw/panel/speedratio")  # [P] 403 without mastership
    async def set_ratio(request: Request) -> Response:
        _needs_edit(request, held)
        speed_ratio(cabinet, await form_of(request))
        return _done()


def _add_rapid(app: FastAPI, cabinet: Cabinet, held: dict[str, str]) -> None:
    @app.get("/rw/rapid/execution")  # [P] recorded: {"status", "state": [{"_type": "rap-execution", ...}]}
    async def execution(request: Request) -> Response:
        return _answer(request, rws_states.execution(cabinet))

    @app.post("/rw/rapid/execution/{action}")  # [L], [P]; start and resetpp need edit mastership, stop never does
    async def order(request: Request, action: str) -> Response:
        if action not in ("start", "stop", "resetpp"):
            raise KeyError(action)
        if action != "stop":
            _needs_edit(request, held)
        execute(cabinet, action, await form_of(request))
        return _done()

    @app.get("/rw/rapid/tasks")  # [L] class rap-task-li
    async def tasks(request: Request) -> Response:
        return _answer(request, rws_states.tasks(cabinet), listed=True)

    @app.get("/rw/rapid/tasks/{task}/modules")  # [L]; of the task, no longer beside it
    async def of_task(request: Request, task: str) -> Response:
        if task != rws_states.TASK:
            raise KeyError(task)
        return _answer(request, modules(), listed=True)


def _add_symbols(app: FastAPI, cabinet: Cabinet, held: dict[str, str]) -> None:
    @app.get("/rw/rapid/symbol/RAPID/{path:path}/data")  # [P]
    async def symbol(request: Request, path: str) -> Response:
        value = cabinet.symbols[path.rsplit("/", 1)[-1]]
        return _answer(request, [State("rap-data", path, {"value": value})])

    @app.post("/rw/rapid/symbol/RAPID/{path:path}/data")  # [P] body value=
    async def set_symbol(request: Request, path: str) -> Response:
        name = path.rsplit("/", 1)[-1]
        if name not in cabinet.symbols:
            raise KeyError(name)
        _needs_edit(request, held)
        cabinet.symbols[name] = (await form_of(request))["value"]
        return _done()


def _add_motion_and_signals(app: FastAPI, cabinet: Cabinet, frames: CellFrames) -> None:
    @app.get("/rw/motionsystem/mechunits/ROB_1/{what}")  # [L]
    async def motion(request: Request, what: str) -> Response:
        return _answer(request, rws_states.motion(cabinet, frames, what, request.query_params))

    @app.get("/rw/iosystem/signals/{path:path}")  # [P] one signal comes as an embedded resource, too
    async def signal(request: Request, path: str) -> Response:
        return _answer(request, rws_states.signal(cabinet, path), listed=True)

    @app.post("/rw/iosystem/signals/{path:path}/set-value")  # [P]
    async def set_signal(request: Request, path: str) -> Response:
        cabinet.set_signal(path.rsplit("/", 1)[-1], (await form_of(request)).get("lvalue", ""))
        return _done()

    @app.get("/rw/elog/{domain}")  # [L] getElogMessages
    async def event_log(request: Request, domain: str) -> Response:
        return _answer(request, rws_states.event_log(cabinet, domain), listed=True)


def _add_mastership(app: FastAPI, held: dict[str, str]) -> None:
    @app.post("/rw/mastership/{domain}/{action}")  # [L], [P]
    async def mastership(request: Request, domain: str, action: str) -> Response:
        session = request.cookies.get("ABBCX", "")
        if domain not in DOMAINS or action not in ("request", "release"):
            raise KeyError(domain)
        if held.get(domain, session) != session:
            raise RefusedError(f"mastership of {domain} is held by another client", NO_MASTERSHIP)
        if action == "request":
            held[domain] = session
        else:
            held.pop(domain, None)
        return _done()

    @app.get("/logout")  # [L]
    async def logout(request: Request) -> Response:
        for domain in [name for name, session in held.items() if session == request.cookies.get("ABBCX")]:
            del held[domain]
        return _answer(request, [])


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
