"""The `sim` profile under podman-compose on free ports, for `verify_images`."""

import contextlib
import json
import os
import socket
import subprocess
import time
import tomllib
import urllib.request
from collections.abc import Callable, Iterator

from tests.docker.images import ROOT, VerificationError, call

PROJECT = "verify-images"
CELL_TOML = "/var/lib/tactile/cell/cell.toml"
PORT_NAMES = ("SERVICE", "EGM", "RWS", "GRIPPER", "CAMERA_LEFT", "CAMERA_RIGHT", "ADMIN")


def free_ports() -> dict[str, str]:
    """One free port a name, for compose's variables."""
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_STREAM) for _ in PORT_NAMES]
    for each in sockets:
        each.bind(("127.0.0.1", 0))
    ports = {f"{name}_PORT": str(each.getsockname()[1]) for name, each in zip(PORT_NAMES, sockets, strict=True)}
    for each in sockets:
        each.close()
    return ports


def free_port() -> str:
    """One more free port."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as each:
        each.bind(("127.0.0.1", 0))
        return str(each.getsockname()[1])


class Loop:
    """The sim profile under podman-compose."""

    def __init__(self, ports: dict[str, str]) -> None:
        self.ports = ports
        self.ready_s: dict[str, float] = {}
        self.compose = ["podman-compose", "--project-name", PROJECT, "--file", str(ROOT / "docker" / "compose.yaml")]

    def container(self, name: str) -> str:
        """The container's name as compose made it."""
        return f"{PROJECT}_{name}_1"

    def up(self, **environment: str) -> None:
        """Restart the cell (arm at its start, object in hand), then the service; wait until both are healthy."""
        os.environ.update(self.ports | environment)
        self.down()
        for name in ("cell", "service-sim"):
            started = time.monotonic()
            call([*self.compose, "--profile", "sim", "up", "--detach", "--no-build", name])
            self.wait_healthy(name, 300)
            self.ready_s[name] = time.monotonic() - started

    def down(self) -> None:
        """Stop and remove the containers; volumes stay for the next start."""
        call([*self.compose, "--profile", "sim", "down", "--timeout", "30"], check=False)

    def healthy(self, name: str) -> bool:
        """Whether the image's own HEALTHCHECK passes now."""
        command = ["podman", "healthcheck", "run", self.container(name)]
        return subprocess.run(command, capture_output=True, check=False).returncode == 0

    def wait_healthy(self, name: str, timeout_s: float) -> float:
        """Seconds until the container is healthy; VerificationError with its last log lines after ``timeout_s``."""
        return waited(lambda: self.healthy(name), timeout_s, f"{name} healthy", lambda: self.logs(name))

    def logs(self, name: str) -> str:
        """The last lines that a container wrote."""
        done = subprocess.run(
            ["podman", "logs", "--tail", "12", self.container(name)], capture_output=True, text=True, check=False
        )
        return done.stdout + done.stderr

    def process(self, name: str) -> int:
        """The host's process id of a container's first process; 0 while it does not run."""
        return int(call(["podman", "inspect", "--format", "{{.State.Pid}}", self.container(name)]))

    @contextlib.contextmanager
    def client(self) -> Iterator[subprocess.Popen[str]]:
        """One insertion in its container, as `compose run` starts it."""
        process = subprocess.Popen(
            self._client(), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=ROOT
        )
        try:
            yield process
        finally:
            if process.poll() is None:
                process.terminate()
                process.wait(30)

    def put_back(self) -> None:
        """Recover from a hold as an operator does: carry the object to its fixture, and open the fingers."""
        cell = tomllib.loads(call(["podman", "exec", self.container("cell"), "cat", CELL_TOML]))
        pick = cell["cycle"]["pick"]
        pose = [f"--{name}-mm={pick[f'{name}_mm']}" for name in "xyz"] + [f"--theta-deg={pick['yaw_deg']}"]
        for command in (["jog", *pose], ["home", "--direction=outward"]):
            call([*self._client(), *command, "--live", f"--config={CELL_TOML}"])

    def _client(self) -> list[str]:
        return [*self.compose, "--profile", "sim-insert", "run", "--rm", "-T", "--no-deps", "robot-client-sim"]

    def truth(self) -> dict[str, object]:
        """The simulated cell's ground truth."""
        with urllib.request.urlopen(f"http://127.0.0.1:{self.ports['ADMIN_PORT']}/truth", timeout=5) as reply:
            answer: dict[str, object] = json.load(reply)
        return answer


def waited(condition: Callable[[], bool], timeout_s: float, what: str, detail: Callable[[], str] = str) -> float:
    """Seconds until ``condition`` holds; VerificationError after ``timeout_s``."""
    started = time.monotonic()
    while not condition():
        if time.monotonic() - started > timeout_s:
            raise VerificationError(f"not {what} after {timeout_s:.0f} s: {' | '.join(detail().splitlines()[-8:])}")
        time.sleep(0.2)
    return time.monotonic() - started
