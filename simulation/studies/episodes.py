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
from robot_client.session.commission import SIDES, WENT_IN, Probe, mistakes
from service.decision.attempt import Attempt
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
    for number, attempt in enumerate(attempts, 1):  # those of each grasp begin with 1
        arrays = attempt.arrays()
        kept = {name: arrays[name] for name in ("steps", "conditions", "decision") if name in arrays}
        if "steps" in kept:
            np.savez(episode.folder / f"attempt_{number:02d}.npz", **kept)  # type: ignore[arg-type]
    summary = {
        "purpose": "probe" if episode.probe else "insert",
        "outcome": "inserted" if row and row["claimed"] else "failed",
        "approach": {"x_mm": job.x_mm, "yaw_deg": job.theta_deg},
        "row": row,
    }
    write_durably(episode.folder / "summary.json", (json.dumps(summary) + "\n").encode())


def named_mistakes(rows: Sequence[Row | None]) -> list[str]:
    """How the cell of these probes at the client's four sides is wired wrong, by the client's own rule."""
    return list(mistakes(tuple(_probe(row, *side) for row, side in zip(rows, SIDES, strict=True))))


def _probe(row: Row | None, x_mm: float, theta_deg: float) -> Probe:
    """What the client would keep of a probe that it took for one at this error."""
    decision = row["trials"][0]["decision"] if row and row["trials"] else {}
    felt = decision.get("estimate") or {}
    said = f"{decision['reason']}: {decision['detail']}" if "detail" in decision else WENT_IN
    return Probe(
        x_mm=x_mm,
        theta_deg=theta_deg,
        estimate_x_mm=felt.get("dx_mm"),
        estimate_theta_deg=felt.get("dtheta_deg"),
        said="" if felt else said,
        insertion_id="simulated",
    )
