"""Insertions and probes in lock step that keep what a recording keeps for learning: what the networks were shown."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reporting.files import write_durably
from robot_client.insertion.state import Phase
from service.contract.wire import Estimate
from service.decision.attempt import Attempt
from service.decision.consistency import mistakes
from simulation.closed_loop.job import Job
from simulation.closed_loop.play import models_of, stage
from simulation.closed_loop.statistics import Row
from simulation.scene.state import PhysicsError

PROBED = frozenset({Phase.RETRACTING, Phase.CORRECTING, Phase.CLOSING, Phase.INSERTED, Phase.FAILED})


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


def named_mistakes(rows: Sequence[Row | None]) -> list[str]:
    """How the cell of these probes is wired wrong; a refusal that names a cause counts as one."""
    told, estimates, named = [], [], set[str]()
    for row in rows:
        for trial in row["trials"] if row else ():
            decision = trial["decision"]
            if decision.get("reason") == "contradictory":
                named.add(decision["detail"])
            if "estimate" in decision and row:
                told.append((row["x_mm"], row["theta_deg"]))
                estimates.append(Estimate.model_validate_json(json.dumps(decision["estimate"])))
    return sorted(named) or mistakes(np.array(told, np.float64).reshape(-1, 2), estimates)
