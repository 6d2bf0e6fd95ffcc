"""Fit the posterior to drawn cells, evaluate it on fresh ones, write a cell's estimates as a world file."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from service.contract import ContractError
from simulation.closed_loop.statistics import Row
from simulation.data.parallel import results
from simulation.data.progress import shown
from simulation.scene.scene import Scene
from simulation.studies.identify import posterior, recorded
from simulation.studies.identify.cells import Cell, pressed
from simulation.studies.identify.posterior import Interval, Posterior


def identified(recordings: Path, scene: Scene, model: Posterior) -> tuple[float, list[Interval]]:
    """The grip of a cell (N), and the intervals of its gel from its commissioning recordings. Raises ContractError."""
    sorted_probes = recorded.read(recordings)
    return next(iter(sorted_probes.presses)), model.intervals(sorted_probes.numbers(scene))


def world_file(grip_n: float, intervals: Sequence[Interval], comment: str) -> str:
    """The world as a file: estimates, with their 90 % intervals as comments."""
    by_key = {one.key: one for one in intervals}
    x, z, reach = (by_key.pop(key) for key in ("margin_x_mm", "margin_z_mm", posterior.REACH))
    return "\n".join(
        [
            f"# {comment}",
            "# Estimates; of cells alike, 90 % lie between the ends that stand behind.",
            f"# {reach.key} = {reach.estimate:.4g}, {range_text(reach)}: for [task] of the client",
            "",
            "[gel]",
            *(f"{one.key} = {one.estimate:.4g}  # {range_text(one)}" for one in by_key.values()),
            f"margin_mm = [{x.estimate:.3g}, {z.estimate:.3g}]  # x {range_text(x)}; z {range_text(z)}",
            "",
            "[grasp]",
            f"force_n = {grip_n:g}",
            "",
        ]
    )


def range_text(one: Interval) -> str:
    return f"{one.low:.3g} to {one.high:.3g}" + ("" if one.known else ", not determined by the probes")


def as_json(grip_n: float, intervals: Sequence[Interval], model: Posterior) -> Row:
    rows = {one.key: {**one._asdict(), "known": one.known} for one in intervals}
    return {"level": posterior.LEVEL, "grip_n": grip_n, "gel": rows, "posterior": dict(model.about)}


def played(cells: Sequence[Cell], workers: int) -> Iterator[Row]:
    """Each cell's ground truth and numbers, in order."""
    return shown("cells press (simulated)", results(pressed, cells, workers, in_order=True), len(cells))


def fitted(rows: Sequence[Row], about: Mapping[str, Any]) -> Posterior:
    """The posterior of these cells, without those that could not press."""
    kept = [row for row in rows if "numbers" in row]
    numbers = np.array([row["numbers"] for row in kept])
    truth = np.array([posterior.truth_of(row["tables"]) for row in kept])
    tiers = np.array([row["tables"]["gel"]["tier"] for row in kept])
    sound = np.isfinite(numbers).all(1)
    return posterior.fit(numbers[sound], truth[sound], tiers[sound], about)


def scored(row: Row, model: Posterior) -> Row:
    """A fresh cell: for each parameter the interval, the truth, and whether it is inside; or why there is none."""
    out = {"number": row["number"], "tier": row["tables"]["gel"]["tier"]}
    if "numbers" not in row:
        return {**out, "refused": row["refused"]}
    truth = posterior.truth_of(row["tables"])
    try:
        intervals = model.intervals(np.array(row["numbers"]))
    except ContractError as error:
        return {**out, "refused": str(error)}
    gel = {}
    for one, by, share in zip(intervals, posterior.PARAMETERS, truth, strict=True):
        ends = {name: float(f"{value:.4g}") for name, value in one._asdict().items() if name != "key"}
        holds = bool(by.share(one.low) - 1e-6 <= share <= by.share(one.high) + 1e-6)
        gel[one.key] = {**ends, "truth": float(f"{by.value(float(share)):.4g}"), "holds": holds}
    return {**out, "gel": gel}
