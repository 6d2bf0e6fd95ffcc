"""The detectors of slip beside each other on real grasps: slides they detect, false alarms, and what they cost.

The first is what a session runs: markers or imprint, with its own settings, armed at rest. An alarm of the others
counts wherever the object is held. Each run counts by its first alarm.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from statistics import median
from typing import Any

from scipy.stats import binomtest

from reporting.statistics import Estimate, percentiles
from simulation.studies.slip.witness import AHEAD_N

Row = Mapping[str, Any]
Alarms = Callable[[Row], Sequence[int]]

LIVE, LEFT_OUT = "what runs live: markers or witness", "the same, witness fitted without the object"
PUT_DOWN, SLIDING, RESTING = "put down", "sliding", "neither"
EITHER, MARKERS, WITNESS = (), ("imprint",), ("slip",)  # parts of a session's perception that a detector lacks


def share(hits: Sequence[bool]) -> dict[str, Any]:
    """A count and its share with the exact interval (Clopper and Pearson 1934)."""
    if not hits:
        return {"hits": 0, "runs": 0, "share": Estimate(float("nan"), 0.0, 1.0)}
    counted = binomtest(sum(hits), len(hits))
    ends = counted.proportion_ci(method="exact")
    return {"hits": sum(hits), "runs": len(hits), "share": Estimate(counted.statistic, ends.low, ends.high)}


def live_alarms(row: Row, *causes: str) -> list[int]:
    """Frames in which the session's detector would stop an armed arm for these causes."""
    live = row["live"] or {}
    return sorted({frame for cause in causes for frame in live.get(f"{cause}_frames", ())})


def detectors(
    slips: Sequence[Row], holds: Sequence[Row], labels: Row, without: Mapping[str, Sequence[int]]
) -> list[dict[str, Any]]:
    """A row for each detector, what runs live first.

    ``slips``: runs with a visible slide before a loss, each its "row" and "label". ``holds``: rows of held runs, whose
    ``labels`` say when they visibly slide and when they are put down. ``without``: frames in which a witness that never
    saw the object scores a slide.
    """
    marks, every = ("markers", "stalled"), ("markers", "stalled", "imprint")

    def left_out(row: Row) -> list[int]:
        armed = set((row["live"] or {}).get("armed_frames", ()))
        return sorted({*live_alarms(row, *marks), *(armed & set(without[row["run"]]))})

    def first_slip(row: Row) -> list[int]:
        return [row["slip_frame"]] if row["slip_frame"] is not None else []

    def watched(row: Row) -> list[int]:
        return [one["slip_frame"] for one in row["fingers"].values() if one["slip_frame"] is not None]

    kinds: tuple[tuple[str, Alarms, tuple[str, ...]], ...] = (
        (LIVE, lambda row: live_alarms(row, *every), EITHER),
        (LEFT_OUT, left_out, EITHER),
        ("the same, without the rule of a stopped patch", lambda row: live_alarms(row, "markers", "imprint"), EITHER),
        ("the same, witness armed with the hold", lambda row: [*live_alarms(row, *marks), *first_slip(row)], EITHER),
        ("markers alone, as live", lambda row: live_alarms(row, *marks), MARKERS),
        ("markers alone, limit for clips", watched, MARKERS),
        ("witness alone, as live", lambda row: live_alarms(row, "imprint"), WITNESS),
        ("witness alone, none while something bears the object", first_slip, WITNESS),
    )
    cost = cost_ms([*(slip["row"] for slip in slips), *holds])
    return [
        _detector(name, alarms, slips, holds, labels) | {"ms": cost["whole"][0] - sum(cost[part][0] for part in lacks)}
        for name, alarms, lacks in kinds
    ]


def _detector(name: str, alarms: Alarms, slips: Sequence[Row], holds: Sequence[Row], labels: Row) -> dict[str, Any]:
    firsts = [min(alarms(slip["row"]), default=None) for slip in slips]
    ahead = [
        None if first is None or first > slip["label"]["lost"] - AHEAD_N else slip["label"]["lost"] - first
        for first, slip in zip(firsts, slips, strict=True)
    ]
    leads = [lead for lead in ahead if lead is not None]
    early = sum(
        lead is not None and slip["label"]["lost"] - lead < slip["label"]["slide"]
        for lead, slip in zip(ahead, slips, strict=True)
    )
    return {
        "name": name,
        "warned": share([lead is not None for lead in ahead]),
        "early": early,
        "lead": percentiles(leads, 50, 5, 95),
        "false": share([bool(alarms(row)) for row in holds]),
        "occasions": dict(Counter(occasion(min(alarms(row)), row["run"], labels) for row in holds if alarms(row))),
        "by_length": [
            share([bool(alarms(row)) for row in holds if (row["frames_n"] < 450) == cut]) for cut in (True, False)
        ],
    }


def occasion(alarm: int, run: str, labels: Row) -> str:
    """What an alarm in a held run met, by the labels: that the object was put down, slid in the hand, or neither."""
    down, slide = labels["set_down"].get(run), labels["held"].get(run, {}).get("slide")
    if down is not None and alarm >= down:
        return PUT_DOWN
    return SLIDING if slide is not None and alarm >= slide else RESTING


def watched_for(slips: Sequence[Row], holds: Sequence[Row]) -> dict[str, Any]:
    """How long the session's detector was armed: slides in time, held runs, and its alarms in 1,000 held frames."""
    spans = [(row["live"] or {}).get("armed_frames", []) for row in holds]
    alarms_n = sum(len(live_alarms(row, "markers", "stalled", "imprint")) for row in holds)
    return {
        "slides": sum(
            any(
                frame <= slip["label"]["lost"] - AHEAD_N
                for frame in (slip["row"]["live"] or {}).get("armed_frames", ())
            )
            for slip in slips
        ),
        "held_runs": sum(map(bool, spans)),
        "false_frames_per_1000": 1000 * alarms_n / max(1, sum(map(len, spans))),
    }


def cost_ms(rows: Sequence[Row]) -> dict[str, list[float]]:
    """Milliseconds of a finger and frame, whole and by part: medians over the runs of each run's 50, 95 and 99 %."""
    costs = [row["live"]["cost_ms"] for row in rows if row["live"]]
    return {part: [median(values) for values in zip(*(one[part] for one in costs), strict=True)] for part in costs[0]}
