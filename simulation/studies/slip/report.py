"""The slip report for people: a table in Markdown and a picture."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from simulation.studies.slip.real_report import real_table


def _share(value: tuple[float, float, float] | list[float]) -> str:
    p, low, high = value
    return f"{100 * p:.1f} ({100 * low:.1f} .. {100 * high:.1f})"


def table(result: dict[str, Any]) -> str:
    """The report as Markdown."""
    lines = [
        "# Slip and marker tracking, measured",
        "",
        "Written by `python -m simulation slip-report`; trials over all eight objects, half of them with friction,",
        "noise, stiffness and light from ranges held out of every other use.",
        "Shares in %, 95 % Wilson intervals in brackets.",
        "",
        "| seen by | trials | right | missed | false | delay, frames: median (5 .. 95 %) | within 1 frame |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, s in {**result["slip"], **result["objects"]}.items():
        d = s["delay_frames"]
        span = f"{d['median']:+.0f} ({d['p5']:+.0f} .. {d['p95']:+.0f})"
        shares = " | ".join(_share(s[key]) for key in ("accuracy", "misses", "false"))
        lines.append(f"| {name} | {s['trials']} | {shares} | {span} | {100 * d['within_one']:.0f} |")
    exact = result["slip"]["images"]["onset_error_frames"]
    lines += ["", f"Motion onset from images: exact frame in {100 * exact['exact']:.1f} % of {exact['n']} trials.", ""]
    if "path_ms" in result:
        path = result["path_ms"]
        cost = f"{path['median']:.1f} ms CPU a frame, one thread (95 %: {path['p95']:.1f})"
        lines += [f"Slip path of a finger (rectify, track, contact, slip, onset): {cost}.", ""]
    lines += _trackers(result["trackers"])
    if result.get("real"):
        lines += real_table(result["real"])
    return "\n".join(lines)


def _trackers(trackers: dict[str, Any]) -> list[str]:
    """What each tracker costs and how exact it is."""
    lines = [
        "## What accuracy costs in time",
        "",
        "| tracker | CPU ms a frame | RMS px, noise 2: vector (per axis) | noise 6 | wrong, % | seen, % | slip right |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, s in trackers.items():
        two, six = s["noise_2"], s["noise_6"]
        wrong = 100 * max(two["wrong_share"], six["wrong_share"])
        seen = 100 * min(two["seen_share"], six["seen_share"])
        numbers = f"{s['cpu_ms_per_frame']:.2f} | {_rms(two['rms_px'])} | {_rms(six['rms_px'])} | {wrong:.2f}"
        lines.append(f"| {name} | {numbers} | {seen:.1f} | {_share(s['accuracy'])} |")
    return [
        *lines,
        "",
        "RMS of the displacement over markers within a quarter pitch of the truth: length of the error vector,",
        "in brackets the error of one axis (smaller by the root of two). Noise in grey levels; the picture shows",
        "one axis. Seen: of how many markers the tracker says where they are; some have left the frame. Wrong: beyond",
        "a quarter pitch. What is left of them with the standard tracker is drawn elsewhere: where the gel is torn by",
        "two thirds of a pitch from one marker to the next, the renderer cannot follow it.",
        "",
        _origin(trackers["standard"]),
        "",
        "![trade-off](slip_report.png)",
        "",
    ]


def _rms(per_axis_px: float) -> str:
    return f"{math.sqrt(2) * per_axis_px:.3f} ({per_axis_px:.3f})"


def _origin(standard: dict[str, Any]) -> str:
    """How much of the error is noise: its variance grows with that of the camera's noise, the rest does not."""
    two, six = (2 * standard[key]["rms_px"] ** 2 for key in ("noise_2", "noise_6"))
    noise = max(0.0, (six - two) / (6**2 - 2**2))  # variance a squared grey level
    fixed = math.sqrt(max(0.0, two - 4 * noise))
    return (
        f"Of the standard tracker's error at 2 grey levels, {math.sqrt(4 * noise):.3f} px is the camera's noise and"
        f" {fixed:.3f} px does not\ndepend on it: markers that few raw pixels see, bilinear rectification,"
        " and how far a picture shows the gel\nthat it was drawn of."
    )


def write(result: dict[str, Any], folder: Path) -> str:
    """Write slip_report.md and slip_report.png into the folder; returns the table."""
    text = table(result)
    (folder / "slip_report.md").write_text(text, encoding="utf-8")
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(11, 4.5))
    for name, s in result["trackers"].items():
        ms = s["cpu_ms_per_frame"]
        mark = "s" if "baseline" in name else "o"
        for key, axis_colour in (("noise_2", "tab:blue"), ("noise_6", "tab:orange")):
            axes[0].plot(ms, s[key]["rms_px"], mark, color=axis_colour)
        axes[0].annotate(name, (ms, s["noise_6"]["rms_px"]), fontsize=7, xytext=(4, 3), textcoords="offset points")
        p, low, high = s["accuracy"]
        axes[1].errorbar(ms, 100 * p, yerr=[[100 * (p - low)], [100 * (high - p)]], fmt=mark, capsize=3)
        axes[1].annotate(name, (ms, 100 * p), fontsize=7, xytext=(4, 3), textcoords="offset points")
    axes[0].set(
        xlabel="CPU ms a frame", ylabel="displacement RMS, px", title="noise 2 (blue) and 6 (orange) grey levels"
    )
    axes[1].set(xlabel="CPU ms a frame", ylabel="slip trials right, %", title="slip accuracy, 95 % interval")
    for axis in axes:
        axis.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(folder / "slip_report.png", dpi=110)
    plt.close(figure)
    return text
