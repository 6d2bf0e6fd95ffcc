"""A cell that learns, in lock step: what its probes and its work show is kept as recordings, from which it adapts.

The software is not told the world. Adapting is training's own command in a process of its own, as on a cell's PC.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reporting.files import write_durably, write_json
from robot_client.insertion.state import Phase
from service.contract import ContractError
from service.contract.wire import Estimate
from service.decision.attempt import Attempt
from service.decision.consistency import mistakes
from simulation.closed_loop import benchmark
from simulation.closed_loop.job import Job
from simulation.closed_loop.play import models_of, stage
from simulation.closed_loop.statistics import Row, ends
from simulation.data.parallel import results
from simulation.data.progress import progress
from simulation.scene.scene import Scene
from simulation.scene.state import PhysicsError
from simulation.scene.worlds import World

PROBED = frozenset({Phase.RETRACTING, Phase.CORRECTING, Phase.CLOSING, Phase.INSERTED, Phase.FAILED})
COUNTED = (
    *("direction_right", "direction_n", "mae_x_mm", "mae_theta_deg", "covered_x", "covered_theta"),
    *("mean_trials", "inserted", "insertions", "claimed_wrongly"),
)


@dataclass(frozen=True)
class Episode:
    """One insertion, or one probe that ends with its first decision, to play and keep in ``folder``."""

    folder: Path
    models: Path
    job: Mapping[str, Any]
    probe: bool


def play(episode: Episode) -> Row | None:
    """In a worker: play and write what a recording keeps for learning; None where the physics came to its end."""
    done = episode.folder / "summary.json"
    if done.exists():
        return dict(json.loads(done.read_text(encoding="utf-8"))["row"] or {}) or None
    job, attempts = Job(**episode.job), list[Attempt]()
    row: Row | None = None
    with contextlib.suppress(PhysicsError):  # the object cannot even be held
        insertion = stage(job, models_of(episode.models))
        insertion.session.on_attempt = attempts.append
        insertion.until = PROBED if episode.probe else frozenset()
        row = {**episode.job, **asdict(insertion.run())}
    _keep(episode, job, attempts, row)
    return row


def _keep(episode: Episode, job: Job, attempts: Sequence[Attempt], row: Row | None) -> None:
    episode.folder.mkdir(parents=True, exist_ok=True)
    for attempt in attempts:
        arrays = attempt.arrays()
        kept = {name: arrays[name] for name in ("steps", "conditions", "decision") if name in arrays}
        if "steps" in kept:
            np.savez(episode.folder / f"attempt_{attempt.arm.attempt:02d}.npz", **kept)  # type: ignore[arg-type]
    summary = {
        "purpose": "probe" if episode.probe else "insert",
        "outcome": "inserted" if row and row["claimed"] else "failed",
        "approach": {"x_mm": job.x_mm, "yaw_deg": job.theta_deg},
        "row": row,
    }
    write_durably(episode.folder / "summary.json", (json.dumps(summary) + "\n").encode())


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
        return {
            "scene": name,
            "index": index,
            "x_mm": float(shares[0] * scene.x_range_mm),
            "theta_deg": float(shares[1] * scene.theta_range_deg),
            "seed": int(np.random.SeedSequence((self.seed, purpose, index)).generate_state(1)[0]),
            "controller": "belief",
            "perception": "fields",
            "condition": self.world.name,
            "changes": dict(self.world.changes),
            "unstated": self.world.unstated.model_dump(mode="json", exclude_defaults=True),
            "cell": self.cell,
        }


@dataclass(frozen=True)
class Plan:
    """How much a cell learns from and is judged on; ``checkpoint`` is the release that is adapted."""

    checkpoint: Path
    models: Path
    probes: int
    insertions: int
    workers: int = 0


PROBES, WORK, JUDGING, SIGNS = 1, 2, 3, 4
SIDES = np.array([(8.0, 0.0), (-8.0, 0.0), (0.0, 8.0), (0.0, -8.0)])
"""Probes that show whether the cell is wired as it says, mm and deg."""
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
    """How the cell is wired wrong, as four probes show it; a refusal that names a cause counts as one."""
    told, estimates, named = list[Any](), list[Estimate](), list[str]()
    for index, (job, (x_mm, theta_deg)) in enumerate(zip(cell.jobs(len(SIDES), SIGNS), SIDES, strict=True)):
        episode = Episode(cell.folder / "signs" / f"{index:05d}", plan.models, job | _at(x_mm, theta_deg), probe=True)
        decisions = [trial["decision"] for trial in (play(episode) or {"trials": []})["trials"]]
        named += [one["detail"] for one in decisions if one.get("reason") == "contradictory"]
        for one in decisions:
            if "estimate" in one:
                told.append((x_mm, theta_deg))
                estimates.append(Estimate.model_validate_json(json.dumps(one["estimate"])))
    return sorted(set(named)) or mistakes(np.array(told).reshape(-1, 2), estimates)


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
    _call("training", "adapt", str(shown), "--from", str(plan.checkpoint), "--out", str(run), "--json", str(verdict))
    said: Row = json.loads(verdict.read_text(encoding="utf-8"))
    if not said["accepted"]:
        return said, None
    _call("export", "onnx", str(run / "checkpoint.pt"), "--out", str(run / "models"))
    return said, run / "models" / "pair"


def _call(package: str, *words: str) -> None:
    done = subprocess.run([sys.executable, "-m", package, *words], capture_output=True, text=True, check=False)
    if done.returncode not in {0, KEPT}:
        raise ContractError(f"python -m {package} {words[0]}: {done.stderr.strip() or done.stdout.strip()}")


KEPT = 3
"""Exit status of ``training adapt`` where the release stays."""


def write(rows: Sequence[Row], path: Path) -> None:
    """Write the rows as JSON."""
    write_json(path, list(rows))
