"""Starts the peers of `make bench-serving` beside the service, and the client that asks all of them in turn."""

import contextlib
import json
import os
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from simulation.cell.emulators.net import free_port
from tests.service.process import service_process

FOLDER = Path(__file__).parent / "peers"
MODEL = "direction.step"
START_S = 120.0


@contextlib.contextmanager
def running(command: list[str], port: int, **options: Any) -> Iterator[None]:
    """A server process, ended with its children; in our session, so that all get the same share of the machine."""
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, process_group=0, **options
    ) as process:
        try:
            deadline = time.monotonic() + START_S
            while True:
                with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
                    break
                if process.poll() is not None or time.monotonic() > deadline:
                    raise RuntimeError(f"{Path(command[0]).name} {command[1]} did not start")
                time.sleep(0.2)
            yield
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, 15)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(10)
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, 9)


@contextlib.contextmanager
def mlserver(python: Path, model: Path, folder: Path) -> Iterator[str]:
    ports = {"http_port": free_port(), "grpc_port": free_port(), "metrics_port": free_port()}
    parameters = {"uri": str(model.resolve())}
    settings = {"name": MODEL, "implementation": "mlserver_model.OnnxModel", "parameters": parameters}
    (folder / "model-settings.json").write_text(json.dumps(settings))
    server = {"host": "127.0.0.1", "parallel_workers": 0, "debug": False, "grpc_max_message_length": 64 << 20}
    (folder / "settings.json").write_text(json.dumps(server | ports))
    environment = os.environ | {"PYTHONPATH": str(FOLDER)}
    code = "import sys; from mlserver.cli import main; sys.argv = ['mlserver', 'start', sys.argv[1]]; main()"
    command = [str(python), "-c", code, str(folder)]
    with running(command, ports["grpc_port"], env=environment):
        yield f"mlserver=grpc@127.0.0.1:{ports['grpc_port']}"


@contextlib.contextmanager
def litserve(python: Path, model: Path) -> Iterator[str]:
    port = free_port()
    command = [str(python), str(FOLDER / "litserve_app.py"), str(model.resolve()), str(port)]
    with running(command, port):
        yield f"litserve=litserve@127.0.0.1:{port}"


def versions(python: Path) -> dict[str, str]:
    code = "import json, importlib.metadata as m; print(json.dumps({n: m.version(n) for n in"
    code += " ('mlserver', 'litserve', 'onnxruntime', 'tritonclient')}))"
    versions: dict[str, str] = json.loads(subprocess.check_output([str(python), "-c", code], text=True))
    return versions


def peers(models: Path, python: Path | None, seconds: float) -> dict[str, Any]:
    """p50 and p99 of the same inference: in process, through the service, MLServer and LitServe."""
    if python is None or not python.exists():
        raise RuntimeError("no --peers-python: the peers were not measured")
    model = models / f"{MODEL}.onnx"
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        cameras = ["--camera-left", "push:", "--camera-right", "push:", "--camera-wait-s", "0"]
        service = stack.enter_context(service_process(models, folder / "r", *cameras, "--requests-per-s", "0"))
        servers = [f"service=oip@127.0.0.1:{service.port}"]
        servers += [stack.enter_context(mlserver(python, model, folder)), stack.enter_context(litserve(python, model))]
        time.sleep(2.0)
        command = [str(python), str(FOLDER / "client.py"), str(model), MODEL, str(3 * seconds), *servers]
        environment = os.environ | {"TOKEN": service.token}
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600, env=environment)
        if done.returncode:
            raise RuntimeError(done.stderr.strip().splitlines()[-1])
        facts: dict[str, Any] = json.loads(done.stdout)
    ours = facts["servers"]["service"]["p50_ms"]
    for name in ("mlserver", "litserve", "in process"):
        facts[f"ratio to {name}"] = round(ours / facts["servers"][name]["p50_ms"], 3)
    return facts | {"versions": versions(python), "model": f"{models.name}/{model.name}"}
