"""Recorded grasps of real objects: the results of `service judge` against labels set by eye.

The rows come from `python -m service judge`, the labels from a JSON file that states how they were set and how each can
be checked. Runs are counted, not frames; a run whose label names no loss can only be called lost falsely.
"""

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from reporting.page import page
from reporting.statistics import wilson
from reporting.table import table
from simulation.studies.slip import witness

Row = Mapping[str, Any]
NEAR_N = 3  # frames within which a loss has to be reported
AHEAD_N = 5  # frames by which a slide has to be reported before the loss


def figures(rows: Sequence[Row], labels: Row, evidence: Row) -> dict[str, Any]:
    """Counts, with their Wilson intervals, and each run beside its label. Raises ValueError if a run has no row.

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
    return {
        "runs": [_beside(slip) for slip in slips],
        "lost": share([_near(slip) for slip in lost]),
        "emptied": len(emptied),
        "lost_of_held": share([row["lost_frame"] is not None for row in holds]),
        "lost_of_held_to_the_end": share([row["lost_frame"] is not None for row in shown]),
        "warned": share([_warned(slip["row"]["slip_frame"], slip) for slip in visible]),
        "warned_by_markers": share([_warned(_by_markers(slip["row"]), slip) for slip in visible]),
        "slip_of_held": share([row["slip_frame"] is not None for row in holds]),
        "slip_of_held_by_markers": share([_by_markers(row) is not None for row in holds]),
        "without_open_frame": sum(row["open_frame"] is None for row in holds),
        "ambiguous": sum(row["ambiguous_n"] for row in rows),
        "ms_a_frame": median(row["ms_a_frame"] for row in rows),
        "witness": _left_out(rows, labels, evidence),
    }


def _left_out(rows: Sequence[Row], labels: Row, evidence: Row) -> dict[str, Any]:
    runs = witness.runs_of(rows, labels, evidence)
    made = witness.without_each_object(runs)
    return {
        "witness_warned": share(made["warned"]),
        "witness_false": share(made["false"]),
        "witness_false_anywhere": share(made["false_anywhere"]),
        **{name: made[name] for name in ("early", "untellable", "false_runs", "false_frames_per_1000", "auc")},
        **{kind: [share(one) for one in made[kind]] for kind in ("short", "long")},
        "model": witness.fitted(runs).round(4).tolist(),
    }


def share(hits: Sequence[bool]) -> dict[str, Any]:
    return {"hits": sum(hits), "runs": len(hits), "share": wilson(sum(hits), len(hits))}


def _near(slip: Row) -> bool:
    frame = slip["row"]["lost_frame"]
    return frame is not None and abs(frame - slip["label"]["lost"]) <= NEAR_N


def _warned(frame: int | None, slip: Row) -> bool:
    return frame is not None and frame <= slip["label"]["lost"] - AHEAD_N


def _by_markers(row: Row) -> int | None:
    """The first frame in which the markers of any finger showed slip, None if they never did."""
    frames = [finger["slip_frame"] for finger in row["fingers"].values() if finger["slip_frame"] is not None]
    return min(frames, default=None)


def _beside(slip: Row) -> dict[str, Any]:
    row, label = slip["row"], slip["label"]
    return {
        "run": slip["run"],
        "slide": label["slide"],
        "lost": label["lost"],
        **{name: row[f"{name}_frame"] for name in ("contact", "hold", "slip")},
        "told_lost": row["lost_frame"],
    }


def grasps_page(data: Row) -> str:
    """The page: worst figure first, then run by run."""
    left_out = data["witness"]
    return page(
        """
        # Real grasps

        Written by `python -m simulation grasps`. Two GelSight Mini fingers grasp, lift and shake an object, which is
        held or leaves the hand: 113 recordings of 23 objects, not in the repository. They were judged by
        `python -m service judge`, whose tracker, open gel, phases and slide witness are those of the live service. The
        labels were set by eye before anything was fitted, and say how each can be checked
        (`tests/service/tools/real_slips.json`). Intervals are Wilson's, 95 %.
        """,
        table(
            [
                (question, counted, wanted)
                for question, name, wanted in _QUESTIONS
                for counted in ([data, left_out][name in left_out][name],)
            ],
            ("question", 0),
            ("runs", lambda row: f"{row[1]['hits']} of {row[1]['runs']}"),
            ("share", lambda row: row[1]["share"], ".0%"),
            ("wanted", 2),
        ),
        _notes(data, left_out),
        "## Run by run\n\nFrames; labels first, then what the shipped detector told, which has seen these objects.",
        table(
            data["runs"],
            ("run", "run"),
            *((title, lambda row, key=key: _frame(row[key])) for title, key in _COLUMNS),
        ),
    )


def _notes(data: Row, left_out: Row) -> str:
    return f"""
        A session stops the arm for the markers' slip and for the slide witness' (off with `TACTILE_IMPRINT_SLIP=0`).
        The evidence of the witness in the last 2 s before a loss is larger than in 2 s of a held run with a chance of
        {left_out["auc"]:.2f}. It alarms in
        {left_out["false_frames_per_1000"]:.2f} of 1,000 held frames, and told {left_out["early"]} of the slides
        before they were seen to begin. Frames whose grid jumped by what may be a pitch, none of them evidence:
        {data["ambiguous"]}. Median run: {data["ms_a_frame"]:.1f} ms CPU a finger and frame, all in.

        - **What is out of sample.** Where an object is said to be left out, the witness and its limit were fitted
          without any run of it; the limit is the one that lets {witness.FALSE_RUNS} held runs of the others alarm, and
          too far is {witness.FURTHER:g} times as far as any held run of the others walked. What it reads was chosen
          with all runs in sight, and so were the limits of the open gel. An alarm counts as in a row of
          `service judge`, while the grasp is held.
        - **Told too late by its label.** {left_out["untellable"]} of the slides begin less than {AHEAD_N} frames
          before the loss, or with the recording itself: nobody could tell them.
        - **Two kinds of recordings.** {_kind(left_out, "short")} of the runs that were cut to the grasp, and
          {_kind(left_out, "long")} of those of 450 frames, which mostly begin in a grip. The witness asks how
          strong the grip is, and that differs between the two kinds: compare within a kind.
        - **Loss and release look alike.** In {data["emptied"]} runs called held both gels are empty at the end, because
          the object was put down or let go. Without the gripper's state that is a loss, and often a slide right
          before. A live session knows whether it asked for a release. No run whose object stays is to be called lost.
        - **An open gel is not always recorded.** In {data["without_open_frame"]} held runs no frame shows one, and the
          object counts as held throughout. A live session learns its gels before each grasp.
        - **Many held objects slide, too**: tubes and screwdrivers turn in the hand. Their alarms count as false here.
          Alarmed with their object left out: {", ".join(left_out["false_runs"]) or "none"}.
        - The length of a recording is no evidence: nothing is compared between runs, and no phase looks ahead.
        """


def _kind(left_out: Row, kind: str) -> str:
    slides, holds = left_out[kind]
    return f"{slides['hits']} of {slides['runs']} slides are told and {holds['hits']} of {holds['runs']} holds alarm"


_QUESTIONS = (
    ("a visible slide is told 5 frames before the loss, or more, its object left out", "witness_warned", "60 %"),
    ("the same, by the markers alone", "warned_by_markers", ""),
    ("held runs with a slip alarm before they are let go, their object left out", "witness_false", "3 of 66"),
    ("the same, with those that are being put down or let go", "witness_false_anywhere", "3 of 66"),
    ("the same, by the shipped witness, which has seen all objects", "slip_of_held", "3 of 66"),
    ("the same, by the markers alone", "slip_of_held_by_markers", ""),
    ("held runs called lost, with those put down or let go", "lost_of_held", "1 of 66"),
    ("held runs called lost whose gels are touched to the end", "lost_of_held_to_the_end", "1 of 66"),
    ("a loss is told within 3 frames", "lost", "90 %"),
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
