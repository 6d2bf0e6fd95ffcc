"""Points of the trade-off: what each choice reaches, with its interval, and what it costs. Each one was measured."""

import hashlib
import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from reporting.statistics import Estimate, normal
from service.contract import ContractError

Points = dict[str, list["Point"]]
SECTIONS = ("networks", "slip", "physics")


@dataclass(frozen=True)
class Point:
    """One choice. ``better`` is the quality (higher is better), ``cost_ms`` what it is traded against.

    ``p50_ms`` and ``p99_ms`` are wall times, None where only processor time was measured. ``about`` is what the choice
    consists of (frames, precision, folder, hash, ...).
    """

    name: str
    better: float
    low: float
    high: float
    cost_ms: float
    p50_ms: float | None
    p99_ms: float | None
    count: int
    mean_trials: Estimate | None
    about: dict[str, Any]

    def __post_init__(self) -> None:
        """Raise ContractError on a figure that is not finite: it would win or lose every comparison silently."""
        if not all(map(math.isfinite, (self.better, self.low, self.high, self.cost_ms))) or self.cost_ms <= 0:
            raise ContractError(f"the point {self.name} has a figure that is not finite or a cost that is not positive")


def pareto(points: list[Point]) -> list[Point]:
    """The points that no other beats in quality at the same or a lower cost, cheapest first."""
    front: list[Point] = []
    for point in sorted(points, key=lambda point: (point.cost_ms, -point.better)):
        if not front or point.better > front[-1].better:
            front.append(point)
    return front


def tracker_points(path: Path) -> list[Point]:
    """Slip trackers of ``python -m simulation slip-report``: accuracy against processor time a frame of a finger."""
    return [
        Point(
            name=name,
            better=row["accuracy"][0],
            low=row["accuracy"][1],
            high=row["accuracy"][2],
            cost_ms=row["cpu_ms_per_frame"],
            p50_ms=None,
            p99_ms=None,
            count=row["trials"],
            mean_trials=None,
            about={"misses": row["misses"][0], "false": row["false"][0], "marker_rms_px": row["noise_6"]["rms_px"]},
        )
        for name, row in _read(path, "trackers").items()
    ]


def physics_points(path: Path) -> list[Point]:
    """Physics settings of ``python -m simulation accuracy``: marker error of the model against time of a poke.

    Quality is minus the mean marker error over the scenes, in um; the interval spans the scenes.
    """
    grouped: dict[str, list[dict[str, Any]]] = {}
    for row in _read(path, "costs"):
        if row["family"] in ("load step", "nodes", "layer"):
            grouped.setdefault(row["setting"], []).append(row)
    points = []
    for name, rows in grouped.items():
        errors = [float(row["model"]["markers_um"]) for row in rows]
        cost = sum(float(row["cpu_ms"]) for row in rows) / len(rows)
        mean = sum(errors) / len(errors)
        about = {"tier": rows[0]["tier"], "scenes": len(rows)}
        points.append(Point(name, -mean, -max(errors), -min(errors), cost, None, None, len(rows), None, about))
    return points


def closed_loop_trials(path: Path, controller: str, files: list[Path] | None = None) -> Estimate | None:
    """Mean trials on the training objects with a 95 % interval of one controller of the closed-loop report.

    None if it was not run, or, with ``files``, if it ran with other networks than these. All controllers ran with
    these objects, only some with others.
    """
    if not path.is_file():
        return None
    if files is not None:
        setup = _read(path, "setup")
        if any(
            setup.get(f"{controller}/{file.name}") != hashlib.sha256(file.read_bytes()).hexdigest() for file in files
        ):
            return None
    rows = [
        row
        for row in _read(path, "summaries")
        if row["controller"] == controller
        and not row["condition"]
        and row["training"]
        and row["mean_trials_standard_error"] is not None
    ]
    count = sum(row["insertions"] for row in rows)
    if not count:
        return None
    shares = [(row["insertions"] / count, row) for row in rows]
    mean = sum(share * row["mean_trials"] for share, row in shares)
    return normal(mean, math.sqrt(sum((share * row["mean_trials_standard_error"]) ** 2 for share, row in shares)))


def report_of(points: Points, about: dict[str, Any]) -> dict[str, Any]:
    """Plain data: what the points have in common, and the points of every section."""
    return about | {section: [asdict(point) for point in members] for section, members in points.items()}


def points_in(report: dict[str, Any]) -> Points:
    """The points of every section back from plain data."""
    return {section: [Point(**row) for row in report[section]] for section in SECTIONS if section in report}


def load_networks(path: Path) -> list[Point]:
    """Read the networks' points back; ContractError names the file that is absent, damaged or older."""
    try:
        return [Point(**row) for row in _read(path, "networks")]
    except TypeError as error:
        raise ContractError(f"{path} is of another version ({error}); write it again with `make tradeoff`") from error


def _read(path: Path, key: str) -> Any:
    try:
        return json.loads(path.read_text())[key]
    except OSError as error:
        raise ContractError(f"cannot read {path}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise ContractError(f"{path} is not a report with {key}: {error!r}") from error
