"""Insertions and probes in lock step that store a recording's training data: the networks' inputs."""

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robot_client.insertion.state import REFUSED, Phase, Plan, State
from robot_client.session.commission.run import GRASPS_N, STALE
from service.contract import wire
from service.decision.attempt import Attempt
from service.decision.work import read_by_depth
from service.durable import write_durably
from simulation.closed_loop.client import trip_s
from simulation.closed_loop.job import Job, Outcome
from simulation.closed_loop.play import Insertion, models_of, stage
from simulation.closed_loop.statistics import Row
from simulation.scene.state import PhysicsError


@dataclass(frozen=True)
class Episode:
    """One insertion, or probes of one grasp, to play and store in ``folder``.

    ``until_slip``: a probe presses until the gel slides.
    """

    folder: Path
    models: Path
    job: Mapping[str, Any]
    until_slip: bool = False


def play(episode: Episode) -> Row:
    """In a worker: play and write a recording's training data; void if the physics failed.

    ``robot_s`` of the row: time of the robot, including the trip to the fixture and back.
    """
    done = episode.folder / "summary.json"
    if done.exists():
        row: Row = json.loads(done.read_text(encoding="utf-8"))["row"]
        if all(row.get(name) == value for name, value in _plain(episode.job).items()):
            return row
        shutil.rmtree(episode.folder)  # of another object, cell or world of the same name
    job, answered, robot_s = Job(**episode.job), list[Answered](), 0.0
    try:
        insertion = stage(job, models_of(episode.models))
        plan = insertion.state.plan.model_copy(update={"until_slip": episode.until_slip})
        insertion.state = State(plan)
        several = plan.only_probes and plan.signs_known
        places = [(job.x_mm, job.theta_deg), *job.starts]
        outcome, answered = _at_each(places, insertion, plan) if several else _in_one_grasp(places[0], insertion, plan)
        robot_s = insertion.seconds.total_s + trip_s(plan)
    except PhysicsError as error:  # the object cannot even be held
        outcome = Outcome.never_began(job, f"physics: {error.reason}: {error}", void=True)
    row = {**episode.job, **asdict(outcome), "robot_s": robot_s}
    _keep(episode, job, answered, row)
    return row


Place = tuple[float, float]
"""A known error: x mm, yaw deg."""
Answered = tuple[Place, Attempt]
"""Where an attempt began, and its end."""


def _in_one_grasp(place: Place, insertion: Insertion, plan: Plan) -> tuple[Outcome, list[Answered]]:
    """Play an insertion, or one probe, until it is answered in one grasp; the attempts are those of the last."""
    attempts = list[Attempt]()
    insertion.session.on_attempt = attempts.append
    outcome = insertion.run()
    while plan.only_probes and (hangs_askew(insertion) or is_stale(insertion)):
        attempts.clear()
        insertion.trials.clear()
        insertion.take_afresh(plan)
        insertion.begin_again(plan)
        insertion.session.on_attempt = attempts.append
        outcome = insertion.run()
    last = insertion.state.plan.insertion_id
    return outcome, [(place, one) for one in attempts if one.arm.insertion_id == last]


def _at_each(places: Sequence[Place], insertion: Insertion, plan: Plan) -> tuple[Outcome, list[Answered]]:
    """Probe at each of these errors, with one grasp at as many as the client can."""
    left = list(zip(places, (plan.approach, *plan.starts), strict=True))
    answered, in_vain_n = list[Answered](), 0
    while True:
        attempts = list[Attempt]()
        insertion.session.on_attempt = attempts.append
        outcome, state = insertion.run(), insertion.state
        went_in = state.phase is Phase.PROBED and len(attempts) < state.attempt
        kept = [(place, one) for (place, _), one in zip(left, attempts, strict=False) if not _stale(one)]
        again = [start for start, one in zip(left, attempts, strict=False) if _stale(one)]
        left, in_vain_n = again + left[len(attempts) + went_in :], 0 if kept or went_in else in_vain_n + 1
        answered += kept
        goes_on = state.phase is Phase.PROBED or state.reason.startswith(REFUSED)
        if not (left and goes_on and in_vain_n < GRASPS_N):
            return outcome, answered
        plan = plan.model_copy(update={"approach": left[0][1], "starts": tuple(pose for _, pose in left[1:])})
        try:
            insertion.take_afresh(plan)
        except PhysicsError:  # what was answered before counts all the same
            return outcome, answered
        insertion.begin_again(plan)


def _stale(attempt: Attempt) -> bool:
    return isinstance(attempt.decision, wire.NoDecision) and attempt.decision.reason == STALE


def hangs_askew(insertion: Insertion) -> bool:
    """Whether a probe was refused for that and is repeated in a new grasp, as the client does."""
    return insertion.state.reason.startswith(REFUSED) and insertion.grasps < GRASPS_N


def is_stale(insertion: Insertion) -> bool:
    """Whether a probe's pictures came too late and it is repeated in a new grasp, as the client does."""
    decisions = [trial["decision"].get("reason") for trial in insertion.trials]
    return decisions == [STALE] and insertion.grasps < GRASPS_N


def _plain(job: Mapping[str, Any]) -> Row:
    """A job as it is read back from a file."""
    return dict(json.loads(json.dumps(job)))


def _keep(episode: Episode, job: Job, answered: Sequence[Answered], row: Row) -> None:
    """Store attempts; on a cell, every grasp is a recording of its own."""
    episode.folder.mkdir(parents=True, exist_ok=True)
    for number, (_, attempt) in enumerate(answered, 1):
        kept = read_by_depth(attempt)
        if "steps" in kept:
            np.savez(episode.folder / f"attempt_{number:02d}.npz", **kept)  # type: ignore[arg-type]
    summary: dict[str, Any] = {
        "purpose": job.purpose,
        "simulated": True,
        "outcome": "inserted" if row["claimed"] else "failed",
        "approach": {"x_mm": job.x_mm, "yaw_deg": job.theta_deg},
        "row": row,
    }
    if job.starts:
        starts = [{"x_mm": x_mm, "yaw_deg": theta_deg} for (x_mm, theta_deg), _ in answered]
        summary |= {"approach": starts[0], "starts": starts[1:]} if starts else {}
    if row["grasps"] > 1:
        summary["continues"] = "the grasp before"
    write_durably(episode.folder / "summary.json", json.dumps(summary) + "\n")
