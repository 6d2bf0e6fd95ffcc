"""The slip report for people: docs/slip_report.md from slip_report.json."""

import math
from typing import Any

from reporting.page import page
from reporting.statistics import Estimate
from reporting.table import Table, table

Row = dict[str, Any]


def slip_page(report: Row) -> str:
    exact, path = report["slip"]["images"]["onset_error_frames"], report["path_ms"]
    return page(
        """
        # Slip and marker tracking, measured

        Written by `python -m simulation slip-report`. Trials are of all eight objects. In half of them, friction,
        noise, stiffness and light come from ranges that are held out of every other use. Shares have their 95 % Wilson
        intervals.
        """,
        _detection([*report["slip"].items(), *report["objects"].items()]),
        f"Motion onset from images: the exact frame in {100 * exact['exact']:.1f} % of {exact['n']} trials.",
        f"Slip path of a finger (rectify, track, contact, slip, onset): {path['median']:.1f} ms CPU a frame on one "
        f"thread (95 %: {path['p95']:.1f}).",
        "## How exactly markers are tracked",
        table(
            report["tracking"].items(),
            ("camera noise, grey levels", lambda row: row[0].removeprefix("noise_")),
            ("RMS px: vector", lambda row: math.sqrt(2) * row[1]["rms_px"], ".3f"),
            ("an axis", "1.rms_px", ".3f"),
            ("wrong", "1.wrong_share", ".2%"),
            ("tracked", "1.tracked_share", ".1%"),
        ),
        """
        RMS: of the displacement, over markers within a quarter pitch of the truth. Tracked: the share of markers whose
        place the tracker states; some have left the frame. Wrong: markers off by more than a quarter pitch. They are
        drawn elsewhere: where the gel is torn by two thirds of a pitch from one marker to the next, the renderer cannot
        follow it.
        """,
        _origin(report["tracking"]),
        "What recordings of real grasps say stands in [real grasps](real_grasps.md).",
    )


def _detection(rows: list[tuple[str, Row]]) -> Table:
    return table(
        rows,
        ("evidence", 0),
        ("trials", "1.trials", "d"),
        ("right", "1.accuracy", ".1%"),
        ("missed", "1.misses", ".1%"),
        ("false", "1.false", ".1%"),
        (
            "delay, frames: median (5 .. 95 %)",
            lambda row: Estimate(*(row[1]["delay_frames"][k] for k in ("median", "p5", "p95"))),
            "+.0f",
        ),
        ("within 1 frame", "1.delay_frames.within_one", ".0%"),
    )


def _origin(tracking: Row) -> str:
    """How much of the error is noise: its variance grows with that of the camera's noise, the rest does not."""
    two, six = (2 * tracking[key]["rms_px"] ** 2 for key in ("noise_2", "noise_6"))
    noise = max(0.0, (six - two) / (6**2 - 2**2))  # variance a squared grey level
    fixed = math.sqrt(max(0.0, two - 4 * noise))
    return (
        f"Of the tracker's error at 2 grey levels, {math.sqrt(4 * noise):.3f} px is the camera's noise, and "
        f"{fixed:.3f} px does not depend on it: few raw pixels show a marker, rectification is bilinear, and a picture "
        "shows the gel that it was drawn of only so exactly."
    )
