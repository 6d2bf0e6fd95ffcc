"""A cell that learns, in lock step: what its probes and its work show is kept as recordings, from which it adapts.

The software is not told the world. Adapting is training's own command in a process of its own, as on a cell's PC.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from reporting.files import write_json
from robot_client.session.commission import SIDES
from service.contract import ContractError
from simulation.closed_loop import benchmark
from simulation.closed_loop.job import job_in
from simulation.closed_loop.statistics import Row, ends
from simulation.data.parallel import results
from simulation.data.progress import progress
from simulation.scene.scene import Scene
from simulation.scene.worlds import World
from simulation.studies.episodes import Episode, named_mistakes, play

COUNTED = (
    *("direction_right", "direction_n", "mae_x_mm", "mae_theta_deg", "covered_x", "covered_theta"),
    *("mean_trials", "inserted", "insertions", "claimed_wrongly"),
)


@dataclass(frozen=True)
class Cell:
    """A world with the objects it packs, and where what is learnt of it is kept."""

    world: World
    objects: Mapping[str, Scene]
    folder: Path
    seed: int
    cell: str = ""

    def jobs(self, count: int, purpose: int) -> list[Row]:
        """``count`` starts, object after object, drawn anew for each purpose."""
        rng = np.random.default_rng((self.seed, purpose))
        names = list(self.objects)
        return [self._job(names[index % len(names)], index, rng, purpose) for index in range(count)]

    def _job(self, name: str, index: int, rng: np.random.Generator, purpose: int) -> Row:
        scene = self.objects[name]
        shares = rng.uniform(-1.0, 1.0, 2)
        start = (shares[0] * scene.x_range_mm, shares[1] * scene.theta_range_deg)
        seed = int(np.random.SeedSequence((self.seed, purpose, index)).generate_state(1)[0])
        return job_in(self.world, name, index, start, seed, cell=self.cell)


@dataclass(frozen=True)
class Plan:
    """How much a cell learns from and is judged on; ``checkpoint`` is the release that is adapted."""

    checkpoint: Path
    models: Path
    probes: int
    insertions: int
    workers: int = 0


PROBES, WORK, JUDGING, SIGNS = 1, 2, 3, 4
FEW = 50


def commission(cell: Cell, plan: Plan) -> Row:
    """Probe, adapt and work in one cell; its row, see ``python -m simulation commission --help``."""
    _played(cell, plan, "probes", plan.models, PROBES, plan.probes, probe=True)
    _played(cell, plan, "work", plan.models, WORK, plan.insertions, probe=False)
    row: Row = {"world": cell.world.name, "mistakes_named": _mistakes(cell, plan)}
    row["released"] = _judged(cell, plan, "released", plan.models)
    verdicts, spent_s = {}, 0.0
    learnt = {"after_50": ("probes", min(FEW, plan.probes)), "after_150": ("probes", plan.probes)}
    for name, (source, count) in {**learnt, "after_work": ("work", plan.insertions)}.items():
        began = time.monotonic()
        verdicts[name], models = _adapted(cell, plan, name, source, count)
        spent_s = max(spent_s, time.monotonic() - began)
        row[name] = row["released"] if models is None else _judged(cell, plan, name, models)
    return {**row, "adapt_s": spent_s, "accepted": {name: verdict["accepted"] for name, verdict in verdicts.items()}}


def _mistakes(cell: Cell, plan: Plan) -> list[str]:
    """How the cell is wired wrong, as four probes show it: from the fixture, where a reversed arm takes the object."""
    arm, jobs = cell.world.unstated, cell.jobs(len(SIDES), SIGNS)
    jobs = [job | _at(arm.x_sign * x, arm.yaw_sign * yaw) for job, (x, yaw) in zip(jobs, SIDES, strict=True)]
    episodes = [
        Episode(cell.folder / "signs" / f"{index:05d}", plan.models, job, probe=True) for index, job in enumerate(jobs)
    ]
    return named_mistakes(list(results(play, episodes, plan.workers, in_order=True)))


def _at(x_mm: float, theta_deg: float) -> Row:
    return {"x_mm": float(x_mm), "theta_deg": float(theta_deg)}


def _played(cell: Cell, plan: Plan, name: str, models: Path, purpose: int, count: int, *, probe: bool) -> list[Row]:
    episodes = [
        Episode(cell.folder / name / f"{index:05d}", models, job, probe)
        for index, job in enumerate(cell.jobs(count, purpose))
    ]
    rows = []
    with progress(f"{cell.world.name}: {name} (simulated)", len(episodes)) as show:
        for done, row in enumerate(results(play, episodes, plan.workers), 1):
            rows += [row] if row else []
            show(done)
    return rows


def _judged(cell: Cell, plan: Plan, name: str, models: Path) -> Row:
    """The same fresh starts for every version of the networks."""
    rows = _played(cell, plan, f"judged-{name}", models, JUDGING, plan.insertions, probe=False)
    counted = {**ends(rows), **benchmark.first_answers(rows)}
    return {key: counted[key] for key in COUNTED}


def _adapted(cell: Cell, plan: Plan, name: str, source: str, count: int) -> tuple[Row, Path | None]:
    """What ``training adapt`` says of the first ``count`` episodes, and where the new networks are if it accepts."""
    shown, run = cell.folder / f"{name}-episodes", cell.folder / name
    shutil.rmtree(shown, ignore_errors=True)
    shown.mkdir(parents=True)
    for index in range(count):
        (shown / f"{index:05d}").symlink_to((cell.folder / source / f"{index:05d}").resolve())
    verdict = run / "verdict.json"
    run.mkdir(parents=True, exist_ok=True)
    verdict.unlink(missing_ok=True)
    told = _call(
        "training", "adapt", str(shown), "--from", str(plan.checkpoint), "--out", str(run), "--json", str(verdict)
    )
    if not verdict.exists():
        return {"accepted": False, "objections": [told]}, None
    said: Row = json.loads(verdict.read_text(encoding="utf-8"))
    if not said["accepted"]:
        return said, None
    models = run / "models"
    told = _call("export", "onnx", str(run / "checkpoint.pt"), "--out", str(models))
    if not list(models.glob("*.step.onnx")):
        raise ContractError(f"python -m export onnx: {told}")
    return said, models


def _call(package: str, *words: str) -> str:
    """What a command said where it refused."""
    done = subprocess.run([sys.executable, "-m", package, *words], capture_output=True, text=True, check=False)
    return done.stderr.strip() or done.stdout.strip()


def write(rows: Sequence[Row], path: Path) -> None:
    """Write the rows as JSON."""
    write_json(path, list(rows))
