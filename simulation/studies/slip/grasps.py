"""Recorded grasps of real objects: the output of `service judge`, compared with labels set by eye.

The rows come from `python -m service judge`, the labels from a JSON file that states how they were set and how each can
be checked. Runs are counted, not frames; a run whose label names no loss can only be called lost falsely.
"""

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from simulation.studies.slip import alarms, witness
from simulation.studies.slip.alarms import share
from simulation.studies.slip.witness import AHEAD_N

Row = Mapping[str, Any]
NEAR_N = 3  # frames within which a loss has to be detected


def figures(rows: Sequence[Row], labels: Row, evidence: Row) -> dict[str, Any]:
    """Counts, with their exact intervals, and each run beside its label. Raises ValueError if a run has no row.

    ``evidence``: the slide witness's readings; it is fitted and evaluated without each object in turn.
    """
    by_run = {row["run"]: row for row in rows}
    missing = sorted(set(labels["slip"]) - set(by_run))
    if missing:
        raise ValueError(f"no rows of {', '.join(missing)}: judge the whole folder")
    slips = [{"run": run, "label": label, "row": by_run[run]} for run, label in labels["slip"].items()]
    holds = [row for run, row in by_run.items() if run not in labels["slip"]]
    emptied = {run for run, label in labels["held"].items() if label["emptied"] is not None}
    lost = [slip for slip in slips if slip["label"]["lost"] is not None]
    visible = [slip for slip in lost if slip["label"]["slide"] is not None]
    shown = [row for row in holds if row["run"] not in emptied]
    recorded = witness.runs_of(rows, labels, evidence)
    without = witness.without_each_object(recorded)
    watched = [row for row in rows if row["live"]]
    return {
        "detectors": alarms.detectors(visible, holds, labels, without["over"]),
        "cost_ms": alarms.cost_ms(rows),
        "slowest_run_ms": max(row["live"]["cost_ms"]["whole"][0] for row in watched),
        "armed": alarms.watched_for(visible, holds),
        "stopped_for_other": share([bool(alarms.live_alarms(row, "other")) for row in holds]),
        "stalled_of_held": sum(bool(alarms.live_alarms(row, "stalled")) for row in holds),
        "refused_gels": sum(len(row["live"]["refused"]) for row in watched),
        "runs": [_beside(row, labels) for row in rows],
        "lost": share([_near(slip) for slip in lost]),
        "emptied": len(emptied),
        "released_of_emptied": share([row["released_frame"] is not None for row in holds if row["run"] in emptied]),
        "released_of_lost": share([slip["row"]["released_frame"] is not None for slip in lost]),
        "lost_of_held": share([row["lost_frame"] is not None for row in holds]),
        "lost_of_held_to_the_end": share([row["lost_frame"] is not None for row in shown]),
        "warned": share([_warned(slip["row"]["slip_frame"], slip) for slip in visible]),
        "slip_of_held": share([row["slip_frame"] is not None for row in holds]),
        "without_open_frame": sum(row["open_frame"] is None for row in holds),
        "ambiguous": sum(row["ambiguous_n"] for row in rows),
        "ms_a_frame": median(row["ms_a_frame"] for row in rows),
        "witness": _left_out(recorded, without),
    }


def _left_out(runs: Sequence[witness.Run], made: Row) -> dict[str, Any]:
    return {
        "witness_warned": share(made["warned"]),
        "witness_false": share(made["false"]),
        "witness_false_anywhere": share(made["false_anywhere"]),
        **{name: made[name] for name in ("early", "untellable", "false_runs", "false_frames_per_1000", "auc")},
        **{kind: [share(one) for one in made[kind]] for kind in ("short", "long")},
        "model": witness.fitted(runs).round(4).tolist(),
    }


def _near(slip: Row) -> bool:
    frame = slip["row"]["lost_frame"]
    return frame is not None and abs(frame - slip["label"]["lost"]) <= NEAR_N


def _warned(frame: int | None, slip: Row) -> bool:
    return frame is not None and frame <= slip["label"]["lost"] - AHEAD_N


def _beside(row: Row, labels: Row) -> dict[str, Any]:
    """A run's labels, its phases, and the first frame and cause for which an armed arm would be stopped for slip."""
    run, slipped = row["run"], row["run"] in labels["slip"]
    label = (
        labels["slip"][run]
        if slipped
        else {"lost": None, "slide": None, "emptied": None, **labels["held"].get(run, {})}
    )
    first, cause = min(
        ((frame, cause) for cause in ("markers", "stalled", "imprint") for frame in alarms.live_alarms(row, cause)[:1]),
        default=(None, None),
    )
    return {
        "run": run,
        "slide": label["slide"],
        "set_down": labels["set_down"].get(run),
        "lost": label["lost"] if slipped else label["emptied"],
        **{name: row[f"{name}_frame"] for name in ("contact", "hold", "slip")},
        "told_lost": row["lost_frame"],
        "released": row["released_frame"],
        "live": first,
        "cause": cause,
        "lead": label["lost"] - first if label["lost"] is not None and first is not None else None,
    }
