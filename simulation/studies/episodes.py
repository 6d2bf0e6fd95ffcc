"""Insertions and probes in lock step that store a recording's training data: the networks' inputs."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reporting.files import write_durably
from robot_client.insertion.state import State
from robot_client.session.commission import SIDES, WENT_IN, Probe, mistakes
from service.decision.attempt import Attempt
from simulation.closed_loop.client import trip_s
from simulation.closed_loop.job import Job, Outcome
from simulation.closed_loop.play import models_of, stage
from simulation.closed_loop.statistics import Row
from simulation.scene.state import PhysicsError


@dataclass(frozen=True)
class Episode:
    """One insertion, or one probe that ends with its first decision, to play and store in ``folder``.

    ``until_slip``: a probe that presses on until the gel slides.
    """

    folder: Path
    models: Path
    job: Mapping[str, Any]
    probe: bool
    until_slip: bool = False


def play(episode: Episode) -> Row:
    """In a worker: play and write a recording's training data; void if the physics failed.

    ``robot_s`` of the row: time of the robot, including the trip to the fixture and back.
    """
    done = episode.folder / "summary.json"
    if done.exists():
        return dict(json.loads(done.read_text(encoding="utf-8"))["row"])
    job, attempts, robot_s = Job(**episode.job), list[Attempt](), 0.0
    try:
        insertion = stage(job, models_of(episode.models))
        plan = insertion.state.plan
        if episode.probe:
            insertion.state = State(plan.model_copy(update={"purpose": "probe", "until_slip": episode.until_slip}))
        insertion.session.on_attempt = attempts.append
        outcome = insertion.run()
        robot_s = insertion.seconds.total_s + trip_s(plan)
    except PhysicsError as error:  # the object cannot even be held
        outcome = Outcome.never_held(job, f"physics: {error}")
    row = {**episode.job, **asdict(outcome), "robot_s": robot_s}
    _keep(episode, job, attempts, row)
    return row


def _keep(episode: Episode, job: Job, attempts: Sequence[Attempt], row: Row) -> None:
    episode.folder.mkdir(parents=True, exist_ok=True)
    for number, attempt in enumerate(attempts, 1):  # those of each grasp are numbered from 1
        kept = attempt.read_by_depth()
        if "steps" in kept:
            np.savez(episode.folder / f"attempt_{number:02d}.npz", **kept)  # type: ignore[arg-type]
    summary = {
        "purpose": "probe" if episode.probe else "insert",
        "outcome": "inserted" if row["claimed"] else "failed",
        "approach": {"x_mm": job.x_mm, "yaw_deg": job.theta_deg},
        "row": row,
    }
    write_durably(episode.folder / "summary.json", (json.dumps(summary) + "\n").encode())


def carried_out(rows: Sequence[Row]) -> bool:
    """Whether each of these probes was answered or inserted; else the client would have stopped there."""
    return not any(row["reason"] and not row["trials"] for row in rows)


def named_mistakes(rows: Sequence[Row]) -> list[str]:
    """Wiring mistakes of the cell from these probes at the client's four sides, by the client's own rule."""
    if not carried_out(rows):
        return []
    return list(mistakes(tuple(_probe(row, *side) for row, side in zip(rows, SIDES, strict=True))))


def _probe(row: Row, x_mm: float, theta_deg: float) -> Probe:
    """The client's record of a probe that it took for one at this error."""
    decision = row["trials"][0]["decision"] if row["trials"] else {}
    felt, turns = decision.get("estimate") or {}, decision.get("turns_deg")
    ending = f"{decision['reason']}: {decision['detail']}" if "detail" in decision else WENT_IN
    return Probe(
        x_mm=x_mm,
        theta_deg=theta_deg,
        estimate_x_mm=felt.get("dx_mm"),
        estimate_theta_deg=felt.get("dtheta_deg"),
        sigma_x_mm=felt.get("sigma_x_mm"),
        sigma_theta_deg=felt.get("sigma_theta_deg"),
        turns_deg=turns and (turns[0], turns[1]),
        said="" if felt else ending,
        insertion_id="simulated",
    )
