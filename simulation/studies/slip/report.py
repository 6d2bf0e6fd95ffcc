"""The slip report for people: docs/slip_report.md from slip_report.json."""

import math
from typing import Any

from reporting.page import page
from reporting.statistics import Estimate
from reporting.table import Table, table

Row = dict[str, Any]
_NOISES = {"used_sensor": "2, used sensor"}


def slip_page(report: Row) -> str:
    exact, path = report["slip"]["images"]["onset_error_frames"], report["path_ms"]
    images, held_out = report["slip"]["images"], report["slip"]["held out, images"]
    return page(
        f"""
        # Slip and marker tracking, simulated

        Slip detection from images misses {_share(held_out["misses"])} of {held_out["slips"]} held-out simulated slips,
        and {_share(images["misses"])} of all {images["slips"]}. It raises a false alarm in {_share(images["false"])} of
        {images["trials"]} trials.

        The trials cover all eight objects. In half of them, friction, noise, stiffness and light come from ranges that
        nothing else uses. Shares have their 95 % Wilson intervals.
        """,
        _detection([*report["slip"].items(), *report["objects"].items()]),
        f"Motion onset from images has the exact frame in {100 * exact['exact']:.1f} % of {exact['n']} trials.",
        f"Rectifying, tracking, contact, slip and onset of a finger take {path['median']:.1f} ms of CPU per frame on "
        f"one thread (95 %: {path['p95']:.1f}). With touch, liveness and imprint, the whole slip path was timed "
        "on [real grasps](real_grasps.md#what-a-finger-and-frame-costs).",
        "## Accuracy of the marker tracker",
        table(
            report["tracking"].items(),
            ("camera noise, grey levels", lambda row: _NOISES.get(row[0], row[0].removeprefix("noise_"))),
            ("RMS px, vector", lambda row: math.sqrt(2) * row[1]["rms_px"], ".3f"),
            ("RMS px, per axis", "1.rms_px", ".3f"),
            ("wrong", "1.wrong_share", ".2%"),
            ("tracked", "1.tracked_share", ".1%"),
        ),
        """
        - **RMS** of the displacement error, over markers within a quarter pitch of the truth.
        - **Wrong:** markers off by more than a quarter pitch. The renderer draws these in the wrong place: it cannot
          follow a gel whose displacement changes by two thirds of a pitch from one marker to the next.
        - **Tracked:** the share of markers with a reported position; some have left the frame.
        - **Used sensor:** uneven light, flares, glue, debris and poor print, after [one raw frame of the
          paper's sensor](imprint.md#what-a-used-sensor-adds) (`camera.used_share = 1`).
        """,
        _origin(report["tracking"]),
        "[Real grasps](real_grasps.md) has the results on recordings of real sensors. "
        "`python -m simulation slip-report` writes this page.",
    )


def _share(of: Any) -> str:
    return f"{Estimate(*of):.1%}"


def _detection(rows: list[tuple[str, Row]]) -> Table:
    return table(
        rows,
        ("evidence", 0),
        ("trials", "1.trials", "d"),
        ("with slip", "1.slips", "d"),
        ("correct", "1.accuracy", ".1%"),
        ("slips missed", "1.misses", ".1%"),
        ("false alarms", "1.false", ".1%"),
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
        f"Of the tracker's error at 2 grey levels, {math.sqrt(4 * noise):.3f} px come from the camera's noise. The "
        f"other {fixed:.3f} px do not depend on it: few raw pixels show a marker, rectification is bilinear, and the "
        "rendered picture reproduces the gel only approximately."
    )
