"""``python -m export tradeoff`` and ``choose``: what accuracy costs in time, and the best network for a budget."""

from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.progress import track

from export.bench.measure import Timing
from export.onnx.decisions import FRAME_COUNTS, PAIR, Decision
from export.tradeoff.candidates import Candidate, find_candidates
from export.tradeoff.points import (
    Point,
    Points,
    closed_loop_trials,
    load_networks,
    physics_points,
    report_of,
    tracker_points,
)
from export.tradeoff.report import NAME, draw, tradeoff_page
from export.tradeoff.scores import Score, Scores, score
from reporting.machine import commit, cpu_name
from reporting.page import publish
from reporting.statistics import Estimate, mean, wilson
from service.contract import ContractError, ModelCard

CONTROLLERS = ("belief", "joint", "paper")
"""Those of the closed-loop report that decide with networks."""


def tradeoff(
    folders: list[Path],
    decisions: Iterable[Decision],
    about: dict[str, Any],
    docs: Path,
    seconds: float,
) -> Points:
    """Measure every candidate, add trackers and physics from their reports, write ``tradeoff.*`` into docs.

    ``about`` names the decisions (split, dataset) and the refused builds, and goes into the report.
    """
    candidates = find_candidates(folders)
    scores = score(candidates, decisions)
    networks: list[Point] = []
    crowding: list[float] = []
    for candidate in track(candidates, description="timing", transient=True):
        timing = candidate.time_step(seconds)
        crowding.append(timing.crowding)
        networks += points_of(candidate, timing, scores[candidate.sha256], docs)
    points: Points = {
        "networks": networks,
        "slip": tracker_points(docs / "slip_report.json"),
        "physics": physics_points(docs / "accuracy.json"),
    }
    about |= {"cpu": cpu_name(), "commit": commit(), "decisions": networks[0].count, "crowding": max(crowding)}
    report = report_of(points, about | {"agreement": agreements(candidates, scores)})
    draw(points, docs / f"{NAME}.png")
    publish(docs, NAME, tradeoff_page(report), report)
    return points


def agreements(candidates: list[Candidate], scores: Scores) -> list[dict[str, Any]]:
    """Each int8 and fp16 build against its fp32 source, by commands after all frames."""
    sources = {c.origin: c for c in candidates if c.precision == "fp32"}
    rows = []
    for build in candidates:
        source = sources.get(build.origin)
        if source is None or source is build:
            continue
        same = scores[source.sha256][_longest()].agreement(scores[build.sha256][_longest()])
        name = f"{build.name} {build.kind} {build.precision}"
        rows.append({"name": name, "summary": str(same), "same_command": same.same_command, **asdict(same)})
    return rows


def points_of(candidate: Candidate, timing: Timing, scores: dict[int, Score], docs: Path) -> list[Point]:
    """One point a number of frames. The cost is the processor time of the steps of a whole decision."""
    trials = _trials(candidate, docs)
    card = candidate.models[0].card
    about = {
        "network": candidate.name,
        "kind": candidate.kind,
        "precision": candidate.precision,
        "input": _input(card),
        "training_data": card.training_data_sha256[:12],
        "step_cpu_ms": timing.cpu_p50_ms,
        "step_p50_ms": timing.p50_ms,
        "step_p99_ms": timing.p99_ms,
        "step_cpu_p99_ms": timing.cpu_p99_ms,
        "size_mb": sum(model.file.stat().st_size for model in candidate.models) / 1e6,
        "folder": str(candidate.folder),
        "files": [model.file.name for model in candidate.models],
        "sha256": candidate.sha256,
    }
    return [
        Point(
            f"{candidate.name} {candidate.kind} {candidate.precision}, {frames} frames",
            *wilson(sum(score.hits), len(score.hits)),
            cost_ms=frames * timing.cpu_p50_ms,
            p50_ms=frames * timing.p50_ms,
            p99_ms=frames * timing.p99_ms,
            count=len(score.hits),
            mean_trials=trials if frames == max(FRAME_COUNTS) else None,
            about=about | {"frames": frames, "mae_mm": mean(score.off_mm), "mae_deg": mean(score.off_deg)},
        )
        for frames, score in scores.items()
    ]


def _input(card: ModelCard) -> str:
    if card.markers:
        return f"{card.markers.rows} x {card.markers.columns} tracked markers"
    return f"{card.frame.height_px} x {card.frame.width_px} px"


def _trials(candidate: Candidate, docs: Path) -> Estimate | None:
    """Mean trials of a closed loop that ran with these very files.

    Two networks in one graph are known by the hashes of the files they were written beside, one folder up.
    """
    if candidate.precision != "fp32":
        return None
    files = [model.file for model in candidate.models]
    if candidate.kind == "shared":
        files = [candidate.folder.parent / name for name in PAIR]
    if not all(file.is_file() for file in files):
        return None
    trials = (closed_loop_trials(docs / "closed_loop.json", controller, files) for controller in CONTROLLERS)
    return next((mean for mean in trials if mean is not None), None)


def choose(budget_ms: float, report: Path, seconds: float) -> str:
    """The most accurate measured network whose step after the last frame keeps the budget at p99, on this machine.

    Times are taken now, accuracies from ``report``; where neighbours stretch the wall time, the processor's counts.
    Raises ContractError on a budget nobody keeps.
    """
    if not budget_ms > 0:
        raise ContractError(f"the budget is {budget_ms} ms, expected more than 0")
    known = {point.about["sha256"]: point for point in load_networks(report) if point.about["frames"] == _longest()}
    folders = sorted({Path(point.about["folder"]) for point in known.values()})
    present = find_candidates([folder for folder in folders if folder.is_dir()])
    timed = [(known[c.sha256], c.time_step(seconds)) for c in present if c.sha256 in known]
    if not timed:
        raise ContractError(f"none of the networks in {report} lies where it was measured; run `make tradeoff`")
    fitting = [(point, timing) for point, timing in timed if timing.budget_p99_ms <= budget_ms]
    if not fitting:
        point, timing = min(timed, key=lambda entry: entry[1].budget_p99_ms)
        raise ContractError(
            f"no network keeps {budget_ms:g} ms here; the fastest is {point.name}: p99 {timing.budget_p99_ms:.2f} ms"
        )
    point, timing = max(fitting, key=lambda entry: (entry[0].better, -entry[1].cpu_p50_ms))
    stretched = timing.budget_p99_ms < timing.p99_ms
    noisy = f" (noisy machine: the processor's p99 counts, {timing.budget_p99_ms:.2f} ms)" if stretched else ""
    return (
        f"{point.name}: right direction {Estimate(point.better, point.low, point.high):.1%}, "
        f"step p50 {timing.p50_ms:.2f} ms, p99 {timing.p99_ms:.2f} ms of {budget_ms:g} ms on {cpu_name()}{noisy}\n"
        f"{point.about['folder']}: {' '.join(point.about['files'])}"
    )


def _longest() -> int:
    return max(FRAME_COUNTS)
