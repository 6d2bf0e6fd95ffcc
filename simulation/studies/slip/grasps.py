"""Recorded grasps of real objects: what `service judge` says of them, against labels set by eye.

The rows come from `python -m service judge`, the labels from a JSON file that says how they were set and how each can
be checked. Runs are counted, not frames; a run whose label names no loss can only be called lost falsely.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from reporting.page import page
from reporting.statistics import wilson
from reporting.table import table

Row = Mapping[str, Any]
NEAR_N = 3  # frames within which a loss has to be told
AHEAD_N = 5  # frames by which a slide has to be told before the loss
FRAMES_HZ = 8  # what these sensors delivered, whatever the files' headers say


def figures(rows: Sequence[Row], labels: Row) -> dict[str, Any]:
    """Counts, with their Wilson intervals, and each run beside its label. Raises ValueError where a run has no row."""
    found = {row["run"]: row for row in rows}
    missing = sorted(set(labels["slip"]) - set(found))
    if missing:
        raise ValueError(f"no rows of {', '.join(missing)}: judge the whole folder")
    slips = [{"run": run, "label": label, "row": found[run]} for run, label in labels["slip"].items()]
    holds = [row for run, row in found.items() if run not in labels["slip"]]
    emptied = {run for run, label in labels["held"].items() if label["emptied"] is not None}
    lost = [slip for slip in slips if slip["label"]["lost"] is not None]
    visible = [slip for slip in lost if slip["label"]["slide"] is not None]
    shown = [row for row in holds if row["run"] not in emptied]
    return {
        "runs": [_beside(slip) for slip in slips],
        "lost": share([_near(slip) for slip in lost]),
        "lost_of_held": share([row["lost_frame"] is not None for row in holds]),
        "lost_of_held_to_the_end": share([row["lost_frame"] is not None for row in shown]),
        "warned": share([_warned(slip) for slip in visible]),
        "slip_of_held": share([row["slip_frame"] is not None for row in holds]),
        "slip_per_1000": 1000 * sum(row["slip_frame"] is not None for row in holds) / sum(map(_held_n, holds)),
        "lead_s": sorted(_lead_s(slip) for slip in visible if _warned(slip)),
        "without_open_frame": sum(row["open_frame"] is None for row in holds),
        "ms_a_frame": max(row["ms_a_frame"] for row in rows),
    }


def share(hits: Sequence[bool]) -> dict[str, Any]:
    return {"hits": sum(hits), "runs": len(hits), "share": wilson(sum(hits), len(hits))}


def _near(slip: Row) -> bool:
    told = slip["row"]["lost_frame"]
    return told is not None and abs(told - slip["label"]["lost"]) <= NEAR_N


def _warned(slip: Row) -> bool:
    told = slip["row"]["slip_frame"]
    return told is not None and told <= slip["label"]["lost"] - AHEAD_N


def _lead_s(slip: Row) -> float:
    return float(slip["label"]["lost"] - slip["row"]["slip_frame"]) / FRAMES_HZ


def _held_n(row: Row) -> int:
    """Frames from the hold to the loss, or to the end."""
    if row["hold_frame"] is None:
        return 0
    end = row["frames_n"] if row["lost_frame"] is None else row["lost_frame"]
    return int(end - row["hold_frame"])


def _beside(slip: Row) -> dict[str, Any]:
    told, label = slip["row"], slip["label"]
    return {
        "run": slip["run"],
        "slide": label["slide"],
        "lost": label["lost"],
        **{name: told[f"{name}_frame"] for name in ("contact", "hold", "slip")},
        "told_lost": told["lost_frame"],
    }


def grasps_page(data: Row) -> str:
    """The page: worst figure first, then run by run."""
    questions = [
        ("a visible slide is told 5 frames before the loss, or more", "warned", "60 % or more"),
        ("held runs called lost", "lost_of_held", "1 of 66 or fewer"),
        ("the same, of those whose gels are touched to the end", "lost_of_held_to_the_end", ""),
        ("a loss is told within 3 frames", "lost", "90 % or more"),
        ("held runs with a slip alarm", "slip_of_held", "3 of 66 or fewer"),
    ]
    return page(
        """
        # Real grasps

        Written by `python -m simulation grasps`. Two GelSight Mini fingers grasp, lift and shake an object, which is
        held or leaves the hand: 113 recordings of 23 objects, not in the repository. They were judged by
        `python -m service judge`, whose tracker, open gel, phases and slip detector are those of the live service. The
        labels were set by eye before anything was fitted, and say how each can be checked
        (`tests/service/tools/real_slips.json`). Intervals are Wilson's, 95 %.
        """,
        table(
            questions,
            ("question", 0),
            ("runs", lambda row: f"{data[row[1]]['hits']} of {data[row[1]]['runs']}"),
            ("share", lambda row: data[row[1]]["share"], ".0%"),
            ("wanted", 2),
        ),
        f"""
        Slip alarms in 1,000 held frames: {data["slip_per_1000"]:.2f}. Slowest run: {data["ms_a_frame"]:.1f} ms CPU a
        finger and frame.

        - **These are no out-of-sample figures for loss.** The limits of the open gel and of the phases were set with
          all these runs in sight. The slip alarm's limit is that of the [slip report](slip_report.md).
        - **Loss and release look alike.** In nine runs called held both gels are empty at the end, because the object
          was put down or let go. Without the gripper's state they are reported as lost. A live session knows whether
          it asked for a release.
        - **An open gel is not always recorded.** In {data["without_open_frame"]} held runs no frame shows one, and the
          object counts as held throughout. A live session learns its gels before each grasp.
        - **Many held objects slide, too**: screwdrivers turn in the hand for the whole run. Their alarms count as
          false here.
        - The length of a recording is no evidence: nothing is compared between runs, and no phase looks ahead.
        """,
        "## Run by run\n\nFrames; labels first, then what was told.",
        table(
            data["runs"],
            ("run", "run"),
            *((title, lambda row, key=key: _frame(row[key])) for title, key in _COLUMNS),
        ),
    )


_COLUMNS = (
    ("slides from", "slide"),
    ("gone at", "lost"),
    ("contact", "contact"),
    ("hold", "hold"),
    ("slip", "slip"),
    ("lost", "told_lost"),
)


def _frame(frame: int | None) -> str:
    return "-" if frame is None else str(frame)
