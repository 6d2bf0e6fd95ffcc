"""``python -m export tradeoff`` and ``choose``: what accuracy costs in time, and the best network for a budget."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rich.progress import track

from export.candidates import FRAME_COUNTS, Candidate, Decision, find_candidates
from export.measure import Timing
from export.points import Point, Table, closed_loop_trials, load_networks, physics_points, save, slip_points, wilson
from export.runtime import cpu_name
from export.tradeoff_report import NAME, draw, write
from service.contract import ContractError
from training.labels import class_of

SHIPPED = {"direction.step.onnx": ("models", "belief"), "joint.step.onnx": ("models/joint", "joint")}
"""Which contender of the closed-loop report played with which released files."""


def tradeoff(folders: list[Path], decisions: Iterable[Decision], split: str, docs: Path, seconds: float) -> Table:
    """Measure every candidate, add slip and physics from their reports, write ``tradeoff`` .md .json .png into docs."""
    candidates = find_candidates(folders)
    hits, count = score(candidates, decisions)
    networks: list[Point] = []
    noise: list[float] = []
    for candidate in candidates:
        timing = candidate.time_step(seconds)
        noise.append(timing.crowding)
        networks += points_of(candidate, timing, hits[id(candidate)], count, docs)
    table: Table = {
        "networks": networks,
        "slip": slip_points(docs / "slip_report.json"),
        "physics": physics_points(docs / "accuracy.json"),
    }
    about: dict[str, Any] = {"cpu": cpu_name(), "split": split, "decisions": count, "crowding": max(noise)}
    save(table, about, docs / f"{NAME}.json")
    draw(table, docs / f"{NAME}.png")
    write(table, about, docs / f"{NAME}.md")
    return table


def score(candidates: list[Candidate], decisions: Iterable[Decision]) -> tuple[dict[int, dict[int, int]], int]:
    """Right directions of each candidate (by id) after each number of frames, and how many decisions there were."""
    hits = {id(candidate): dict.fromkeys(FRAME_COUNTS, 0) for candidate in candidates}
    count = 0
    for decision in track(decisions, description="deciding", transient=True):
        count += 1
        label = int(class_of(decision.truth[None])[0])
        for candidate in candidates:
            for frames, chosen in candidate.classes(decision).items():
                hits[id(candidate)][frames] += int(chosen == label)
    if not count:
        raise ContractError("there is no decision to score the networks on")
    return hits, count


def points_of(candidate: Candidate, timing: Timing, hits: dict[int, int], count: int, docs: Path) -> list[Point]:
    """One point a number of frames. The cost is the processor time of the steps of a whole decision."""
    trials = candidate.mean_trials()
    home, who = SHIPPED[candidate.models[0].file.name]
    if trials is None and candidate.folder == Path(home) and candidate.precision == "fp32":
        trials = closed_loop_trials(docs / "closed_loop.json", who)
    about = {
        "network": candidate.name,
        "precision": candidate.precision,
        "step_cpu_ms": timing.cpu_p50_ms,
        "step_p50_ms": timing.p50_ms,
        "step_p99_ms": timing.p99_ms,
        "folder": str(candidate.folder),
        "files": [model.file.name for model in candidate.models],
        "sha256": candidate.sha256,
    }
    return [
        Point(
            f"{candidate.name} {candidate.precision}, {frames} frames",
            *wilson(hits[frames], count),
            cost_ms=frames * timing.cpu_p50_ms,
            p50_ms=frames * timing.p50_ms,
            p99_ms=frames * timing.p99_ms,
            count=count,
            mean_trials=trials if frames == max(FRAME_COUNTS) else None,
            about=about | {"frames": frames},
        )
        for frames in FRAME_COUNTS
    ]


def choose(budget_ms: float, report: Path, seconds: float) -> str:
    """The most accurate measured network whose step after the last frame keeps the budget at p99, on this machine.

    Times are taken now, accuracies from ``report``. Raises ContractError on a budget nobody keeps.
    """
    if not budget_ms > 0:
        raise ContractError(f"the budget is {budget_ms} ms, expected more than 0")
    known = {point.about["sha256"]: point for point in load_networks(report) if point.about["frames"] == _longest()}
    folders = sorted({Path(point.about["folder"]) for point in known.values()})
    present = find_candidates([folder for folder in folders if folder.is_dir()])
    timed = [(known[c.sha256], c.time_step(seconds)) for c in present if c.sha256 in known]
    if not timed:
        raise ContractError(f"none of the networks in {report} lies where it was measured; run `make tradeoff`")
    fitting = [(point, timing) for point, timing in timed if timing.p99_ms <= budget_ms]
    if not fitting:
        point, timing = min(timed, key=lambda entry: entry[1].p99_ms)
        raise ContractError(
            f"no network keeps {budget_ms:g} ms here; the fastest is {point.name}: p99 {timing.p99_ms:.2f} ms"
        )
    point, timing = max(fitting, key=lambda entry: (entry[0].better, -entry[1].cpu_p50_ms))
    noisy = " (noisy machine: wall times are the neighbours' too)" if timing.noisy else ""
    return (
        f"{point.name}: right direction {100 * point.better:.1f} % [{100 * point.low:.1f}, {100 * point.high:.1f}], "
        f"step p50 {timing.p50_ms:.2f} ms, p99 {timing.p99_ms:.2f} ms of {budget_ms:g} ms on {cpu_name()}{noisy}\n"
        f"{point.about['folder']}: {' '.join(point.about['files'])}"
    )


def _longest() -> int:
    return max(FRAME_COUNTS)
