"""The choices of settings that no other beats by more than chance."""

from collections.abc import Mapping, Sequence

from reporting.statistics import Estimate, mean
from simulation.closed_loop.statistics import Row, claimed_wrongly
from simulation.studies.pace.points import Point
from simulation.studies.pace.resampled import faster


def beaten_by(points: Sequence[Point], by_name: Mapping[str, Sequence[Row]]) -> dict[str, list[str]]:
    """For each point the names of those that beat it; every point has the same starts, in the same order.

    A choice beats another if it is better beyond chance (the 95 % interval of the paired difference excludes none) in
    seconds per box, force, boxes or false claims, and worse beyond chance in none. Only choices that any cell can run
    beat others.
    """
    general = [point.name for point in points if not point.needs]
    return {
        point.name: [name for name in general if name != point.name and _beats(by_name[name], by_name[point.name])]
        for point in points
    }


def _beats(rows: Sequence[Row], other: Sequence[Row]) -> bool:
    merits = [_sign(faster(rows, other), 1.0), *(_sign(gain, 0.0) for gain in _gains(rows, other))]
    return max(merits) > 0 and min(merits) >= 0


def _gains(rows: Sequence[Row], other: Sequence[Row]) -> list[Estimate]:
    """Gains in force, inserted boxes and false claims: means per start."""
    pairs = list(zip(rows, other, strict=True))
    return [
        mean([theirs["course"]["force_n"] - mine["course"]["force_n"] for mine, theirs in pairs]),
        mean([float(mine["inserted"]) - float(theirs["inserted"]) for mine, theirs in pairs]),
        mean([float(claimed_wrongly(theirs)) - float(claimed_wrongly(mine)) for mine, theirs in pairs]),
    ]


def _sign(gain: Estimate, none: float) -> int:
    """1 if the whole interval is better than ``none``, -1 if it is worse, 0 if chance may explain it."""
    return (gain.low > none) - (gain.high < none)


def front(points: Sequence[Row]) -> set[str]:
    """Names of the published choices that any cell can run and that none beats."""
    return {point["name"] for point in points if not point["needs"] and not point["beaten_by"]}
