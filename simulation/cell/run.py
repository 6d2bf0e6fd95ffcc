"""The whole loop: simulated cell, service and robot client as processes, one insertion at a time.

The cell emulates robot, gripper and cameras on loopback; the service and the client are the real ones.
"""

import json
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple
from urllib.request import urlopen

from service.contract.shipped import released_models
from service.contract.token import TOKEN_FILE
from service.contract.toml import read_toml
from simulation.cell import run_report
from simulation.cell.children import Child, Children, Compiling
from simulation.cell.config import client_config
from simulation.cell.emulators.net import HOST, free_port
from simulation.cell.options import CellOptions, draw_start
from simulation.cell.run_report import Result
from simulation.scene.scene import Scene
from simulation.scene.worlds import load_scene, load_world

CELL_READY_S = 300.0  # the first start on a machine compiles the physics
SERVICE_READY_S = 90.0


class RunError(ValueError):
    """The requested run cannot be set up."""


@dataclass(frozen=True)
class LiveOptions:
    """What runs: the simulated cell, the service and the robot client."""

    object: str = "rectangle"
    """A name or a TOML file."""
    world: str | None = None
    """A world file: gel, grasp, blocks, cameras (see docs/worlds.md); the project's own cell if left out."""
    seed: int = 0
    """Seed of start, grasp, optics and noise."""
    controller: Literal["belief", "heuristic"] = "belief"
    """Controller that chooses the corrections."""
    models: Path = field(default_factory=released_models)
    """Folder with the networks."""
    out: Path = Path("runs")
    """Folder for the runs."""
    fps: int | None = None
    """Camera rate: 30, 60 or 90; the sensor's if left out."""
    egm_lag_ms: float = 20.0
    """Lag of the emulated arm."""
    link: Literal["egm", "socket"] = "egm"
    """How the client drives the arm: EGM, or the RAPID sockets of a controller without that option."""
    client: Path | None = None
    """Tables that override the cell's client configuration, as `choose` writes them."""

    def chosen(self) -> dict[str, Any]:
        """The client's tables that were chosen; raises RunError for a file that is none of tables."""
        tables = read_toml(self.client) if self.client else {}
        if loose := [key for key, table in tables.items() if not isinstance(table, dict)]:
            raise RunError(f"--client {self.client}: {', '.join(loose)}: expected tables, as [ramps.descend]")
        return tables

    def check(self) -> None:
        """Raise ValueError or OSError, before a process starts, for what none would take."""
        if not list(self.models.glob("*.onnx")):
            raise RunError(f"--models {self.models}: no folder with .onnx files; expected those of the service")
        CellOptions(fps=self.fps, egm_lag_ms=self.egm_lag_ms).check()
        self.chosen()
        scene_of(self)


@dataclass(frozen=True)
class RunOptions(LiveOptions):
    """Insert an object in the simulated cell, in real time, through the real protocols."""

    x_mm: float | None = None
    """Position error at the start; drawn from the seed if left out."""
    theta_deg: float | None = None
    """Yaw error at the start; drawn from the seed if left out."""
    timeout_s: float = 240.0
    """Time limit of one insertion."""


@dataclass(frozen=True)
class Start:
    """One insertion to do."""

    object: str
    x_mm: float
    theta_deg: float
    seed: int


def scene_of(options: LiveOptions) -> Scene:
    """The object in its world; raises SceneError."""
    scene = load_scene(options.object)
    return load_world(options.world).around(scene) if options.world else scene


def start_of(options: RunOptions) -> Start:
    """The insertion to do; raises SceneError or RunError before anything starts."""
    if not options.timeout_s > 0:
        raise RunError(f"--timeout-s {options.timeout_s}: expected more than 0")
    options.check()
    x_mm, theta_deg = draw_start(scene_of(options), options.seed)
    x_mm = x_mm if options.x_mm is None else options.x_mm
    theta_deg = theta_deg if options.theta_deg is None else options.theta_deg
    CellOptions(x_mm=x_mm, theta_deg=theta_deg).check()
    return Start(options.object, x_mm, theta_deg, options.seed)


def _say(text: str) -> None:
    print(text, flush=True)


def start_cell(start: Start, options: LiveOptions, folder: Path, *, fed: bool = False) -> Child:
    """The cell as a process; ``fed``: a new object stands in the fixture each time the arm is back there."""
    arguments = [
        *("--object", start.object, "--x-mm", str(start.x_mm), "--theta-deg", str(start.theta_deg)),
        *("--seed", str(start.seed), "--egm-lag-ms", str(options.egm_lag_ms)),
        *("--out", str(folder / "cell")),
        *(("--fps", str(options.fps)) if options.fps else ()),
        *(("--world", options.world) if options.world else ()),
        *(("--feed",) if fed else ()),
    ]
    return Child("cell", "simulation", ["cell", *arguments], folder / "cell.log")


def ready_cell(cell: Child, folder: Path) -> dict[str, Any]:
    """The cell's description once it is ready; shows the compiler's progress where it has to compile."""
    compiling = Compiling(_say)
    cell.until("cell: ready", CELL_READY_S, compiling.look)
    facts: dict[str, Any] = json.loads((folder / "cell" / "cell.json").read_text())
    return facts


def start_service(facts: dict[str, Any], options: LiveOptions, folder: Path, port: int = 0) -> Child:
    arguments = [
        *("--models", str(options.models), "--calibration", facts["calibration"], "--port", str(port)),
        *("--camera-left", facts["cameras"]["left"], "--camera-right", facts["cameras"]["right"]),
        *("--recordings", str(folder / "recordings"), "--state", str(folder / "state")),
        *("--controller", options.controller),
        *("--frame-rate-hz", str(facts["fps"])),
    ]
    return Child("service", "service", ["run", *arguments], folder / "service.log")


def _start_client(facts: dict[str, Any], url: str, options: RunOptions, folder: Path) -> Child:
    approach, config = facts["approach"], folder / "client.toml"
    token = (folder / "state" / TOKEN_FILE).resolve()
    config.write_text(client_config(facts, url, token, options.link, options.chosen()))
    arguments = [
        *("--live", "--config", str(config), "--log", str(folder / "episode.jsonl")),
        *(f"--x-mm={approach['x_mm']:.4f}", f"--theta-deg={approach['yaw_deg']:.4f}"),
    ]
    return Child("robot client", "robot_client", ["insert", *arguments], folder / "client.log")


class Loop(NamedTuple):
    """The three processes of one insertion and the cell's description of itself."""

    cell: Child
    service: Child
    client: Child
    facts: dict[str, Any]
    episode: Path


@contextmanager
def loop(
    start: Start, options: RunOptions, folder: Path, through: Callable[[str], str] = lambda url: url, port: int = 0
) -> Iterator[Loop]:
    """Start cell, service and client, in this order; end them in reverse order. Raises ChildError if one fails.

    ``through``: maps the service's own address to the one by which the client reaches it.
    """
    folder.mkdir(parents=True)
    with Children() as children:
        cell = children.add(start_cell(start, options, folder))
        facts = ready_cell(cell, folder)
        service = children.add(start_service(facts, options, folder, port))
        url = service.until("service ready at ", SERVICE_READY_S).rsplit(" ", 1)[1]
        client = children.add(_start_client(facts, through(url), options, folder))
        children.go_first()
        yield Loop(cell, service, client, facts, folder / "episode.jsonl")


def insert(start: Start, options: RunOptions, folder: Path) -> Result:
    """Start everything, do one insertion, and end everything; raises ChildError if a process fails."""
    _say(f"{start.object}: start error x {start.x_mm:+.2f} mm, yaw {start.theta_deg:+.2f} deg, seed {start.seed}")
    port = free_port(socket.SOCK_STREAM)
    _say(f"page: http://{HOST}:{port}/ (from when the service runs, in some seconds)")
    _say("starting the simulated cell")
    with loop(start, options, folder, port=port) as running:
        watched = (running.cell, running.service)
        began, used = time.monotonic(), [child.cpu_s() for child in watched]
        for line in running.client.lines(watched, options.timeout_s):
            _say(f"  {line}")
        if running.client.code not in (0, 1):
            running.client.check()
        seconds = time.monotonic() - began
        cores = [(child.cpu_s() - before) / seconds for child, before in zip(watched, used, strict=True)]
        with urlopen(f"{running.facts['admin_url']}/truth", timeout=5.0) as answer:  # noqa: S310 our own child on loopback
            truth = json.load(answer)
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")
    return run_report.collect(
        truth,
        running.episode,
        object_name=start.object,
        x_mm=start.x_mm,
        theta_deg=start.theta_deg,
        seed=start.seed,
        seconds=seconds,
        cores=(cores[0], cores[1]),
    )
