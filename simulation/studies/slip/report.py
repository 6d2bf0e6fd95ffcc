"""The slip report for people: docs/slip_report.md and its figure, from slip_report.json."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from reporting.figure import BLUE, ORANGE, drawing, label
from reporting.page import page
from reporting.statistics import Estimate
from reporting.table import Table, table
from simulation.studies.slip.real_report import real_part

Row = dict[str, Any]


def slip_page(report: Row) -> str:
    """The whole of docs/slip_report.md."""
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
        "## What accuracy costs in time",
        _trackers(list(report["trackers"].items())),
        """
        RMS: of the displacement, over markers within a quarter pitch of the truth. It is the length of the error
        vector, with the error of one axis in brackets. Noise is in grey levels. The figure shows one axis. Tracked:
        the share of markers whose place the tracker states; some have left the frame. Wrong: markers off by more than
        a quarter pitch. Those that the standard tracker has wrong are drawn elsewhere: where the gel is torn by two
        thirds of a pitch from one marker to the next, the renderer cannot follow it.
        """,
        _origin(report["trackers"]["standard"]),
        "![trade-off](slip_report.png)",
        *(real_part(report["real"]) if report.get("real") else ()),
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


def _trackers(rows: list[tuple[str, Row]]) -> Table:
    return table(
        rows,
        ("tracker", 0),
        ("CPU ms a frame", "1.cpu_ms_per_frame", ".2f"),
        ("RMS px, noise 2: vector (per axis)", lambda row: _rms(row[1]["noise_2"])),
        ("noise 6", lambda row: _rms(row[1]["noise_6"])),
        ("wrong", lambda row: max(row[1][noise]["wrong_share"] for noise in ("noise_2", "noise_6")), ".2%"),
        ("tracked", lambda row: min(row[1][noise]["tracked_share"] for noise in ("noise_2", "noise_6")), ".1%"),
        ("slip right", "1.accuracy", ".1%"),
    )


def _rms(at_noise: Row) -> str:
    return f"{math.sqrt(2) * at_noise['rms_px']:.3f} ({at_noise['rms_px']:.3f})"


def _origin(standard: Row) -> str:
    """How much of the error is noise: its variance grows with that of the camera's noise, the rest does not."""
    two, six = (2 * standard[key]["rms_px"] ** 2 for key in ("noise_2", "noise_6"))
    noise = max(0.0, (six - two) / (6**2 - 2**2))  # variance a squared grey level
    fixed = math.sqrt(max(0.0, two - 4 * noise))
    return (
        f"Of the standard tracker's error at 2 grey levels, {math.sqrt(4 * noise):.3f} px is the camera's noise, and "
        f"{fixed:.3f} px does not depend on it: few raw pixels show a marker, rectification is bilinear, and a picture "
        "shows the gel that it was drawn of only so exactly."
    )


def draw(trackers: dict[str, Row], path: Path) -> None:
    """Displacement error and slip accuracy of every tracker over its CPU time."""
    with drawing(path, 1, 2) as panels:
        errors, shares = panels[0]
        for place, (name, row) in enumerate(trackers.items()):
            ms, marker = row["cpu_ms_per_frame"], "s" if "baseline" in name else "o"
            for key, colour in (("noise_2", BLUE), ("noise_6", ORANGE)):
                errors.plot(ms, row[key]["rms_px"], marker, color=colour)
            label(errors, (ms, row["noise_6"]["rms_px"]), name, dy=(4.0, -9.0, 12.0, -17.0)[place % 4])
            share, low, high = (100 * value for value in row["accuracy"])
            shares.errorbar(share, name, xerr=[[share - low], [high - share]], fmt=marker, color=BLUE, capsize=3)
        errors.set(title="noise of 2 (blue) and 6 (orange) grey levels", xlim=(0, None), ylim=(0, None))
        errors.set(xlabel="CPU ms a frame", ylabel="displacement RMS, px")
        shares.set(title="slip accuracy, 95 % interval", xlabel="slip trials right, %")
        shares.invert_yaxis()
