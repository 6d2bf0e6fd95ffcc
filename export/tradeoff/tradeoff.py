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
    Table,
    closed_loop_trials,
    load_networks,
    mean_interval,
    physics_points,
    save,
    tracker_points,
    wilson,
)
from export.tradeoff.report import NAME, draw, write
from export.tradeoff.scores import Score, Scores, score
from reporting.machine import cpu_name
from service.contract import ContractError, ModelCard

PLAYERS = ("belief", "joint", "paper")
"""Contenders of the closed-loop report that decide with networks: the controllers they were made for."""


def tradeoff(
    folders: list[Path],
    decisions: Iterable[Decision],
    about: dict[str, Any],
    docs: Path,
    seconds: float,
    kept: Path | None = None,
) -> Table:
    """Measure every candidate, add trackers and physics from their reports, write ``tradeoff.*`` into docs.

    ``about`` says what the decisions are (split, dataset) and goes into the report. ``kept`` is a file of answers of
    earlier runs on the same decisions: a network whose files did not change is not asked again.
    """
    candidates = find_candidates(folders)
    scores = score(candidates, decisions, kept)
    networks: list[Point] = []
    crowding: list[float] = []
    for candidate in track(candidates, description="timing", transient=True):
        timing = candidate.time_step(seconds)
        crowding.append(timing.crowding)
        networks += points_of(candidate, timing, scores[candidate.sha256], docs)
    table: Table = {
        "networks": networks,
        "slip": tracker_points(docs),
        "physics": physics_points(docs / "accuracy.json"),
    }
    about = about | {"cpu": cpu_name(), "decisions": networks[0].count, "crowding": max(crowding)}
    about["agreement"] = agreements(candidates, scores)
    save(table, about, docs / f"{NAME}.json")
    draw(table, docs / f"{NAME}.png")
    write(table, about, docs / f"{NAME}.md")
    return table


def agreements(candidates: list[Candidate], scores: Scores) -> list[dict[str, Any]]:
    """Each int8 and fp16 twin against its fp32 source, by commands after all frames."""
    sources = {c.origin: c for c in candidates if c.precision == "fp32"}
    rows = []
    for twin in candidates:
        source = sources.get(twin.origin)
        if source is None or source is twin:
            continue
        found = scores[source.sha256][_longest()].agreement(scores[twin.sha256][_longest()])
        name = f"{twin.name} {twin.kind} {twin.precision}"
        rows.append({"name": name, "verdict": str(found), "same_command": found.same_command, **asdict(found)})
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
            *wilson(sum(said.hits), len(said.hits)),
            cost_ms=frames * timing.cpu_p50_ms,
            p50_ms=frames * timing.p50_ms,
            p99_ms=frames * timing.p99_ms,
            count=len(said.hits),
            mean_trials=trials if frames == max(FRAME_COUNTS) else None,
            about=about
            | {"frames": frames, "mae_mm": mean_interval(said.off_mm), "mae_deg": mean_interval(said.off_deg)},
        )
        for frames, said in scores.items()
    ]


def _input(card: ModelCard) -> str:
    if card.markers:
        return f"{card.markers.rows} x {card.markers.columns} tracked markers"
    return f"{card.frame.height_px} x {card.frame.width_px} px"


def _trials(candidate: Candidate, docs: Path) -> tuple[float, float, float] | None:
    """Mean trials of a closed loop that was played with these very files.

    Two networks in one graph are known by the hashes of the files they were written beside, one folder up.
    """
    trials = candidate.mean_trials()
    if trials is not None or candidate.precision != "fp32":
        return trials
    files = [model.file for model in candidate.models]
    if candidate.kind == "shared":
        files = [candidate.folder.parent / name for name in PAIR]
    if not all(file.is_file() for file in files):
        return None
    played = (closed_loop_trials(docs / "closed_loop.json", who, files) for who in PLAYERS)
    return next((found for found in played if found is not None), None)


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
    fitting = [(point, timing) for point, timing in timed if timing.judged_p99_ms <= budget_ms]
    if not fitting:
        point, timing = min(timed, key=lambda entry: entry[1].judged_p99_ms)
        raise ContractError(
            f"no network keeps {budget_ms:g} ms here; the fastest is {point.name}: p99 {timing.judged_p99_ms:.2f} ms"
        )
    point, timing = max(fitting, key=lambda entry: (entry[0].better, -entry[1].cpu_p50_ms))
    stretched = timing.judged_p99_ms < timing.p99_ms
    noisy = f" (noisy machine: judged by the processor's p99, {timing.judged_p99_ms:.2f} ms)" if stretched else ""
    return (
        f"{point.name}: right direction {100 * point.better:.1f} % [{100 * point.low:.1f}, {100 * point.high:.1f}], "
        f"step p50 {timing.p50_ms:.2f} ms, p99 {timing.p99_ms:.2f} ms of {budget_ms:g} ms on {cpu_name()}{noisy}\n"
        f"{point.about['folder']}: {' '.join(point.about['files'])}"
    )


def _longest() -> int:
    return max(FRAME_COUNTS)
