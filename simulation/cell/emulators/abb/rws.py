"""Robot Web Services 1.0 of the emulated IRC5 over HTTP: digest access, the ABBCX cookie, states, actions, event log.

An action answers 204 when it is accepted, not when it is done: poll the state. The resources are those that clients of
this cell use; any other path answers 404 as the controller does. ABB's reference (3HAC050973-001 rev M) lists them by
service and address; each group names its service there.
"""

import asyncio
import secrets
import time
from collections.abc import Awaitable, Callable
from typing import Any

from fastapi import FastAPI, Request, Response, WebSocket
from starlette.middleware.base import BaseHTTPMiddleware

from simulation.cell.emulators.abb import rws_states
from simulation.cell.emulators.abb.cabinet import Cabinet, RefusedError
from simulation.cell.emulators.abb.frames import CellFrames
from simulation.cell.emulators.abb.rws_format import (
    JSON_TYPE,
    XHTML_TYPE,
    Digest,
    State,
    as_json,
    as_xhtml,
    error_body,
)
from simulation.cell.emulators.abb.rws_more import add_more, form_of
from simulation.cell.emulators.abb.rws_subscriptions import add_subscriptions
from simulation.cell.emulators.faults import FaultBoard, take

USER, PASSWORD = "Default User", "robotics"  # the controller's factory default
MAX_SESSIONS = 70
COOKIES = ("-http-session-", "ABBCX")  # both must be kept; the second one names the session
_SESSION_IDLE_S = 300.0
NOT_FOUND, BAD_ARGUMENT = -1073445859, -1073445865

Next = Callable[[Request], Awaitable[Response]]


def _wants_json(request: Request) -> bool:
    return request.query_params.get("json") == "1"


def _answer(request: Request, states: list[State]) -> Response:
    base = f"http://{request.headers.get('host', '')}{request.url.path}"
    if _wants_json(request):
        return Response(as_json(base, states), media_type=JSON_TYPE)
    return Response(as_xhtml(base, states), media_type=XHTML_TYPE)


def _refusal(request: Request, status: int, code: int, text: str) -> Response:
    wants_json = _wants_json(request)
    media = JSON_TYPE if wants_json else XHTML_TYPE
    return Response(error_body(code, text, wants_json=wants_json), status, media_type=media)


class Gate:
    """The checks before every resource: faults, digest access, sessions."""

    def __init__(self, board: FaultBoard, credentials: type[Digest] = Digest) -> None:
        self._board = board
        self._credentials = credentials(USER, PASSWORD)
        self._sessions: dict[str, float] = {}
        self.abort: Callable[[Any], None] = lambda _client: None

    def authorised(self, cookie: str | None, header: str | None, method: str) -> bool:
        """True for a live session's cookie or a correct digest."""
        return (cookie is not None and cookie in self._sessions) or self._credentials.accepts(header, method)

    def admits(self, socket: WebSocket) -> bool:
        """The same for a WebSocket."""
        return self.authorised(socket.cookies.get("ABBCX"), socket.headers.get("authorization"), "GET")

    def session(self, cookie: str | None) -> str | None:
        """The caller's session, a new one if it has none; None if the controller has too many."""
        now_s = time.monotonic()
        self._sessions = {key: last_s for key, last_s in self._sessions.items() if now_s - last_s < _SESSION_IDLE_S}
        if cookie not in self._sessions or cookie is None:
            if len(self._sessions) >= MAX_SESSIONS:
                return None
            cookie = secrets.token_hex(16)
        self._sessions[cookie] = now_s
        return cookie

    async def __call__(self, request: Request, call_next: Next) -> Response:
        faults = self._board.faults.rws
        if faults.delay_ms:
            await asyncio.sleep(faults.delay_ms / 1000.0)
        if take(faults, "reset_next"):
            self.abort(request.client)
        if take(faults, "refuse_next"):
            return _refusal(request, 503, -1, "too many active connections")
        cookie = request.cookies.get("ABBCX")
        if not self.authorised(cookie, request.headers.get("authorization"), request.method):
            return Response(status_code=401, headers={"WWW-Authenticate": self._credentials.challenge()})
        session = self.session(cookie)
        if session is None:
            return _refusal(request, 503, -1, "too many sessions; keep the ABBCX cookie")
        response = await call_next(request)
        if take(faults, "garbage_next"):
            response = Response(secrets.token_bytes(64), media_type=JSON_TYPE)
        if session != cookie:
            for name in COOKIES:
                response.set_cookie(name, session, path="/", httponly=True)
        if request.url.path == "/logout":
            self._sessions.pop(session, None)
        return response


def create_app(cabinet: Cabinet, frames: CellFrames, gate: Gate) -> FastAPI:
    """The web service of one controller; every handler runs on the event loop that advances the cabinet."""
    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)
    app.add_middleware(BaseHTTPMiddleware, dispatch=gate)
    _add_panel(app, cabinet)
    _add_execution(app, cabinet)
    _add_symbols(app, cabinet)
    _add_motion_and_signals(app, cabinet, frames)
    _add_log_and_mastership(app, cabinet)
    add_more(app, _answer)
    add_subscriptions(app, cabinet, gate.admits)

    async def refused(request: Request, error: Exception) -> Response:
        code = error.code if isinstance(error, RefusedError) else BAD_ARGUMENT
        return _refusal(request, 403 if isinstance(error, RefusedError) else 400, code, str(error))

    async def missing(request: Request, _error: Exception) -> Response:
        return _refusal(request, 404, NOT_FOUND, f"no resource {request.url.path}")

    app.add_exception_handler(ValueError, refused)
    app.add_exception_handler(RefusedError, refused)
    app.add_exception_handler(KeyError, missing)
    app.add_exception_handler(404, missing)
    app.add_exception_handler(405, missing)
    return app


def _done() -> Response:
    return Response(status_code=204)


def _expect(request: Request, *actions: str) -> str:
    action = request.query_params.get("action", "")
    if action not in actions:
        raise ValueError(f"action {action!r}, expected {' or '.join(actions)}")
    return action


def _add_panel(app: FastAPI, cabinet: Cabinet) -> None:
    """RobotWare Services, Panel Service."""

    @app.get("/rw/panel/{what}")
    async def panel(request: Request, what: str) -> Response:
        return _answer(request, rws_states.panel(cabinet, what))

    @app.post("/rw/panel/ctrlstate")
    async def switch(request: Request) -> Response:
        _expect(request, "setctrlstate")
        motors(cabinet, await form_of(request))
        return _done()

    @app.post("/rw/panel/speedratio")
    async def set_speed_ratio(request: Request) -> Response:
        _expect(request, "setspeedratio")
        speed_ratio(cabinet, await form_of(request))
        return _done()


def motors(cabinet: Cabinet, form: dict[str, str]) -> None:
    """Switch the motors as the form says; raises ValueError, or RefusedError where the controller refuses."""
    wanted = form.get("ctrl-state")
    if wanted not in ("motoron", "motoroff"):
        raise ValueError(f"ctrl-state {wanted!r}, expected motoron or motoroff")
    cabinet.request_motors(wanted == "motoron")


def speed_ratio(cabinet: Cabinet, form: dict[str, str]) -> None:
    """Set the speed as the form says; raises ValueError."""
    ratio = float(form.get("speed-ratio", "nan"))
    if not 0.0 <= ratio <= 100.0:
        raise ValueError(f"speed-ratio {ratio}, expected 0 to 100")
    cabinet.speed_ratio = int(ratio)


def execute(cabinet: Cabinet, action: str, form: dict[str, str]) -> None:
    """Start, stop or resetpp; raises ValueError, or RefusedError where the controller refuses."""
    if action == "start":
        if (cycle := form.get("cycle", "asis")) != "asis":
            cabinet.cycle = cycle
        cabinet.request_start()
    elif action == "stop":
        if form.get("stopmode", "stop") not in ("cycle", "instr", "stop", "qstop"):
            raise ValueError(f"stopmode {form['stopmode']!r}, expected cycle, instr, stop or qstop")
        cabinet.request_stop()
    else:
        cabinet.request_main()


def _add_execution(app: FastAPI, cabinet: Cabinet) -> None:
    """RobotWare Services, RAPID Service: execution and tasks."""

    @app.get("/rw/rapid/execution")
    async def execution(request: Request) -> Response:
        return _answer(request, rws_states.execution(cabinet))

    @app.post("/rw/rapid/execution")
    async def order(request: Request) -> Response:
        execute(cabinet, _expect(request, "start", "stop", "resetpp"), await form_of(request))
        return _done()

    @app.get("/rw/rapid/tasks")
    async def tasks(request: Request) -> Response:
        return _answer(request, rws_states.tasks(cabinet))

    @app.post("/rw/rapid/tasks/{task}")
    async def task(request: Request, task: str) -> Response:
        _expect(request, "activate", "deactivate")
        if task != rws_states.TASK:
            raise KeyError(task)
        return _done()


def _add_symbols(app: FastAPI, cabinet: Cabinet) -> None:
    """RobotWare Services, RAPID Service: symbols."""

    @app.get("/rw/rapid/symbol/data/RAPID/{path:path}")
    async def symbol(request: Request, path: str) -> Response:
        return _answer(request, [State("rap-data", path, {"value": cabinet.symbols[path.rsplit("/", 1)[-1]]})])

    @app.post("/rw/rapid/symbol/data/RAPID/{path:path}")
    async def set_symbol(request: Request, path: str) -> Response:
        _expect(request, "set")
        name, form = path.rsplit("/", 1)[-1], await form_of(request)
        if name not in cabinet.symbols:
            raise KeyError(name)
        cabinet.symbols[name] = form["value"]
        return _done()

    @app.post("/rw/rapid/symbols")
    async def search(request: Request) -> Response:
        _expect(request, "search-symbols")
        names = [State("rap-sympropvar-li", name, {"name": name, "symtyp": "per"}) for name in cabinet.symbols]
        return _answer(request, names)


def _add_motion_and_signals(app: FastAPI, cabinet: Cabinet, frames: CellFrames) -> None:
    """RobotWare Services: System Service, Motion Service, I/O Service."""

    @app.get("/rw/system")
    async def system(request: Request) -> Response:
        return _answer(request, rws_states.SYSTEM)

    @app.get("/rw/motionsystem/mechunits/ROB_1/{what}")
    async def motion(request: Request, what: str) -> Response:
        return _answer(request, rws_states.motion(cabinet, frames, what, request.query_params))

    @app.get("/rw/iosystem/signals/{path:path}")
    async def signal(request: Request, path: str) -> Response:
        return _answer(request, rws_states.signal(cabinet, path))

    @app.post("/rw/iosystem/signals/{path:path}")
    async def set_signal(request: Request, path: str) -> Response:
        _expect(request, "set")
        cabinet.set_signal(path.rsplit("/", 1)[-1], (await form_of(request)).get("lvalue", ""))
        return _done()


def _add_log_and_mastership(app: FastAPI, cabinet: Cabinet) -> None:
    """RobotWare Services: Elog Service, Mastership; Controller Service: environment variables; logout."""

    @app.get("/rw/elog/{domain}/")
    @app.get("/rw/elog/{domain}")
    async def event_log(request: Request, domain: str) -> Response:
        return _answer(request, rws_states.event_log(cabinet, domain))

    @app.get("/ctrl/{variable}")
    async def environment(request: Request, variable: str) -> Response:
        return _answer(request, [State("ctrl-env", variable, {"_value": f"/{variable.strip('$').lower()}"})])

    @app.post("/rw/mastership/{domain:path}")
    @app.post("/rw/mastership")
    async def mastership(request: Request, domain: str = "") -> Response:
        if domain not in ("", "cfg", "motion", "rapid"):
            raise KeyError(domain)
        _expect(request, "request", "release")
        return _done()

    @app.get("/logout")
    async def logout(request: Request) -> Response:
        return _answer(request, [])
