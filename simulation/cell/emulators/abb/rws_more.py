"""RWS 1.0 resources that foreign clients use beyond this cell's own: users, files, modules, CFG, queues.

Each route cites its page of ABB's reference (3HAC050973-001, by its name there). Files live in memory.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from urllib.parse import parse_qsl

from fastapi import FastAPI, Request, Response

from simulation.cell.emulators.abb import rws_states
from simulation.cell.emulators.abb.cabinet import RefusedError
from simulation.cell.emulators.abb.rws_format import XHTML_TYPE, State

Answer = Callable[[Request, list[State]], Response]
MAX_FILE_BYTES, MAX_FILES = 1 << 20, 64
NO_SUCH_REQUEST = -1073445870  # user_rmmp_poll_page
QUEUE_EXISTS = -1073445879  # as abb-robot-client knows it
MAX_QUEUES, MAX_MESSAGES = 16, 256
MODULES = {"TactileEgm": "ProgMod", "BASE": "SysMod"}
ROBOT = {"name": "ROB_1", "use_robot_type": "ROB1_1600_1.45_6", "use_joint_0": "rob1_1"}
CFG = {"moc": {"ROBOT": [ROBOT]}, "sys": {"CAB_TASKS": [{"Name": rws_states.TASK, "Type": "NORMAL"}]}}


@dataclass(slots=True)
class Disk:
    """The controller's files, by their path."""

    files: dict[str, bytes] = field(default_factory=dict)

    def put(self, path: str, content: bytes) -> bool:
        """Keep a file; True if it is new. Raises ValueError beyond what the emulator has room for."""
        new = path not in self.files
        if len(content) > MAX_FILE_BYTES or (new and len(self.files) >= MAX_FILES):
            raise ValueError(f"{path} of {len(content)} bytes: at most {MAX_FILES} files of {MAX_FILE_BYTES} bytes")
        self.files[path] = content
        return new

    def listed(self, folder: str) -> list[State]:
        """The contents of a folder; raises KeyError where it holds nothing."""
        inside = {p: c for p, c in self.files.items() if p.rpartition("/")[0].lower() == folder.lower()}
        if not inside and folder.lower() not in {"$home", "$temp", ""}:
            raise KeyError(folder)
        return [State("fs-file", p.rpartition("/")[2], {"fs-size": len(c)}) for p, c in inside.items()]


async def fields(request: Request) -> list[tuple[str, str]]:
    """The fields of a form, in their order."""
    return parse_qsl((await request.body())[:65536].decode("utf-8", "replace"), keep_blank_values=True)


async def form_of(request: Request) -> dict[str, str]:
    return dict(await fields(request))


def add_more(app: FastAPI, answer: Answer) -> None:
    """Add the routes; errors are answered by the app's handlers of KeyError (404) and ValueError (400)."""
    _add_users(app, answer)
    _add_files(app, answer)
    _add_configuration(app, answer)
    _add_modules(app, answer)
    _add_queues(app, answer)


def modules() -> list[State]:
    """The modules of the one task."""
    return [State("rap-module-info-li", name, {"name": name, "type": kind}) for name, kind in MODULES.items()]


def _add_users(app: FastAPI, answer: Answer) -> None:
    asked: list[str] = []

    @app.get("/users")  # user_page: the users who are logged in
    async def users(request: Request) -> Response:
        return answer(request, [State("user-li", "Default User", {"alias": "", "application": "", "locale": "remote"})])

    @app.post("/users")  # user_register_page: 201 with the user's resource
    async def register() -> Response:
        return Response(status_code=201, headers={"Location": "/users/1"}, media_type=XHTML_TYPE)

    @app.get("/users/rmmp")  # user_rmmp_resource_page
    async def granted(request: Request) -> Response:
        privilege = "modify" if asked else "none"
        return answer(request, [State("user-rmmp", "state", {"userid": "0", "privilege": privilege})])

    @app.post("/users/rmmp")  # user_rmmp_request_page: 202 accepted, as XHTML
    async def ask(request: Request) -> Response:
        asked[:] = [] if request.query_params.get("action") == "cancel" else ["modify"]
        return Response(status_code=202, media_type=XHTML_TYPE)

    @app.get("/users/rmmp/poll")  # user_rmmp_poll_page: nothing to poll without a request
    async def poll(request: Request) -> Response:
        shown = {"status": "GRANTED"} if asked else {"code": NO_SUCH_REQUEST, "status": "NO SUCH REQUEST"}
        return answer(request, [State("user-rmmp-poll", "state", shown)])


def _add_files(app: FastAPI, answer: Answer) -> None:
    disk = Disk()

    @app.get("/fileservice/{path:path}")  # fs_file_get_page, fs_directory_get_page
    async def read(request: Request, path: str) -> Response:
        if path in disk.files:
            return Response(disk.files[path], media_type="application/octet-stream")
        return answer(request, disk.listed(path.rstrip("/")))

    @app.put("/fileservice/{path:path}")  # fs_file_upload_page: 201 for a new file, 200 for one replaced
    async def write(request: Request, path: str) -> Response:
        return Response(status_code=201 if disk.put(path, await request.body()) else 200, media_type=XHTML_TYPE)

    @app.delete("/fileservice/{path:path}")  # fs_file_actions_page: fs-delete
    async def delete(path: str) -> Response:
        del disk.files[path]
        return Response(status_code=204)


def _add_modules(app: FastAPI, answer: Answer) -> None:
    @app.get("/rw/rapid/modules")  # rapid_modules_get_page; the task is required
    async def listed(request: Request) -> Response:
        if request.query_params.get("task") != rws_states.TASK:
            raise ValueError(f"task {request.query_params.get('task')!r}, expected {rws_states.TASK}")
        return answer(request, modules())


def _add_configuration(app: FastAPI, answer: Answer) -> None:
    """Read-only: the configuration belongs to the simulator, and clients cannot change it."""

    @app.get("/rw/cfg")  # cfg_page
    async def domains(request: Request) -> Response:
        return answer(request, [State("cfg-domain-li", name) for name in CFG])

    @app.get("/rw/cfg/{domain}")  # cfg_domain_page
    async def types(request: Request, domain: str) -> Response:
        return answer(request, [State("cfg-dt-li", name) for name in CFG[domain.lower()]])

    @app.get("/rw/cfg/{domain}/{kind}/instances")  # cfg_domain_type_instances; attributes as abb_librws reads them
    async def instances(request: Request, domain: str, kind: str) -> Response:
        configured = CFG[domain.lower()][kind.upper()]
        return answer(
            request, [State("cfg-dt-instance-li", next(iter(one.values())), _attributes(one)) for one in configured]
        )


def _attributes(instance: dict[str, str]) -> dict[str, list[State]]:
    return {"attrib": [State("cfg-ia-t-li", name, {"value": value}) for name, value in instance.items()]}


def _add_queues(app: FastAPI, answer: Answer) -> None:
    """Message queues of option 616-1 (ABB's pages on dipc). No RAPID task here reads one: clients meet each other."""
    queues: dict[str, deque[dict[str, str]]] = {}

    @app.post("/rw/dipc")  # dipc-create
    async def create(request: Request) -> Response:
        name = (await form_of(request))["dipc-queue-name"]
        if name in queues:
            raise RefusedError(f"the queue {name} exists", QUEUE_EXISTS)
        if len(queues) >= MAX_QUEUES:
            raise ValueError(f"more than {MAX_QUEUES} queues")
        queues[name] = deque(maxlen=MAX_MESSAGES)
        return Response(status_code=201, media_type=XHTML_TYPE)

    @app.post("/rw/dipc/{name}")  # dipc-send
    async def send(request: Request, name: str) -> Response:
        form = await form_of(request)
        keys = ("dipc-data", "dipc-userdef", "dipc-msgtype", "dipc-cmd")
        queues[name].append({key: form[key] for key in keys} | {"queue-name": form["dipc-src-queue-name"]})
        return Response(status_code=204)

    @app.get("/rw/dipc/{name}/")  # dipc-read: messages are read once
    @app.get("/rw/dipc/{name}")
    async def read(request: Request, name: str) -> Response:
        rows = [State("dipc-read-li", name, message) for message in queues[name]]
        queues[name].clear()
        return answer(request, rows)
