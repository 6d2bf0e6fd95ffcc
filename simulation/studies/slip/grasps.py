"""Recorded grasps of real objects: the output of `service judge`, compared with labels set by eye.

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
from simulation.studies.slip.witness import AHEAD_N

Row = Mapping[str, Any]
NEAR_N = 3  # frames within which a loss has to be detected


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
        "released_of_emptied": share([row["released_frame"] is not None for row in holds if row["run"] in emptied]),
        "released_of_lost": share([slip["row"]["released_frame"] is not None for slip in lost]),
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
    """The first frame in which the markers of any finger detected slip, None if they never did."""
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
        "released": row["released_frame"],
    }


def grasps_page(data: Row) -> str:
    """The page: the questions with their targets, the method, then run by run."""
    left_out = data["witness"]
    return page(
        f"""
        # Real grasps

        What ships detected {_of(data["warned"])} visible slides at least {AHEAD_N} frames before the loss; fitted
        without the object, {_of(left_out["witness_warned"])} were detected. The target is 60 %.
        {_of(left_out["witness_false_anywhere"])} held runs alarmed, and {_of(data["lost_of_held"])}
        were reported as lost, {_of(data["lost_of_held_to_the_end"])} of those whose gels stay in contact.
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
            ("target", 2),
        ),
        """
        ## How it was measured

        Two GelSight Mini fingers grasp, lift and shake an object: 113 recordings of 23 objects, not in the repository,
        evaluated by `python -m service judge` with the code of the live service. The labels were set by eye before
        anything was fitted (`tests/service/tools/real_slips.json` states how each can be checked). Intervals are 95 %
        Wilson intervals.
        """,
        _notes(data, left_out),
        """
        ## Run by run

        Frame numbers: first the labels, then the output of the shipped detector, which was fitted to these objects.
        """,
        table(
            data["runs"],
            ("run", "run"),
            *((title, lambda row, key=key: _frame(row[key])) for title, key in _COLUMNS),
        ),
        "`python -m simulation grasps` writes this page.",
    )


def _notes(data: Row, left_out: Row) -> str:
    return f"""
        - **Held-out objects.** The witness and its limit were fitted without any run of the object. The limit is the
          one at which {witness.FALSE_RUNS} held runs of the other objects alarm. A motion of {witness.FURTHER:g} times
          the longest travel in any held run of the others alarms as well. The inputs of the witness and the limits of
          the open gel were chosen with all runs in view.
        - **Evidence.** The witness has more evidence in the last 2 s before a loss than in 2 s of a held run with a
          probability of {left_out["auc"]:.2f}. It alarms in {left_out["false_frames_per_1000"]:.2f} of 1,000 held
          frames, and detected {left_out["early"]} of the slides before their labelled start.
        - **Jumps of the grid** by about one marker pitch, in {data["ambiguous"]} frames, do not count as evidence.
        - **Cost.** The median run takes {data["ms_a_frame"]:.1f} ms of CPU per finger and frame.

        ## What it means and what is left

        A session stops the arm on slip detected by the markers or by the slide witness (`TACTILE_IMPRINT_SLIP=0`
        switches the witness off).

        - **Impossible by its label.** {left_out["untellable"]} of the slides begin less than {AHEAD_N} frames before
          the loss, or with the recording itself.
        - **Two kinds of recordings**, with grips of different strength, which the witness uses: compare within one kind
          only. {_kind(left_out, "short")} in the runs that were cut to the grasp; {_kind(left_out, "long")} in those of
          450 frames, most of which begin in a grip.
        - **Loss and release look alike.** In {data["emptied"]} runs labelled as held, the object was put down or let go
          at the end. An end counts as [released](decisions/0190-a-reversed-load-is-a-release.md) if the load on a gel
          reversed before, otherwise as a loss. A live session calls every end that it did not command a loss.
        - **An open gel is not always recorded.** {data["without_open_frame"]} held runs contain no frame of one, and
          the object counts as held throughout. A live session learns its gels before each grasp.
        - **Many held objects slide, too:** tubes and screwdrivers turn in the hand. Their alarms count as false here.
          Alarms with the object held out: {", ".join(left_out["false_runs"]) or "none"}.
        - **No look-ahead.** Nothing is compared between runs, and no phase uses later frames.
        """


def _kind(left_out: Row, kind: str) -> str:
    slides, holds = left_out[kind]
    return f"{_of(slides)} slides are detected and {_of(holds)} held runs alarm"


def _of(counted: Row) -> str:
    return f"{counted['hits']} of {counted['runs']}"


_QUESTIONS = (
    ("visible slide detected at least 5 frames before the loss, object held out", "witness_warned", "60 %"),
    ("the same, shipped witness, fitted to all objects", "warned", "60 %"),
    ("the same, markers only", "warned_by_markers", ""),
    ("held run with a slip alarm before the release, object held out", "witness_false", "3 of 66"),
    ("the same, including putting down and letting go", "witness_false_anywhere", "3 of 66"),
    ("the same, shipped witness, fitted to all objects", "slip_of_held", "3 of 66"),
    ("the same, markers only", "slip_of_held_by_markers", ""),
    ("held run reported as lost, including putting down and letting go", "lost_of_held", "1 of 66"),
    ("held run reported as lost although the gels are touched to the end", "lost_of_held_to_the_end", "1 of 66"),
    ("object put down or let go reported as released", "released_of_emptied", ""),
    ("loss detected within 3 frames", "lost", "90 %"),
    ("loss reported as released", "released_of_lost", ""),
)
_COLUMNS = (
    ("label: slide", "slide"),
    ("label: loss", "lost"),
    ("contact", "contact"),
    ("hold", "hold"),
    ("slip", "slip"),
    ("lost", "told_lost"),
    ("released", "released"),
)


def _frame(frame: int | None) -> str:
    return "-" if frame is None else str(frame)
