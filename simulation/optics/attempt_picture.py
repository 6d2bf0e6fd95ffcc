"""One picture per attempt: both fingers' frames, the markers' motion, and the decision."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Required, TypedDict

import numpy as np
from numpy.typing import NDArray

ARROW_SCALE = 3.0  # motions are a few px: drawn three times longer than they are
Motion = tuple[NDArray[np.floating], NDArray[np.floating]]
"""Rest positions of markers and their motion, both ([2,] rows, cols, 2) in px: (u, v)."""
_FINGER_NAMES = ("left finger (+y)", "right finger (-y)")


class Decision(TypedDict, total=False):
    """Facts shown besides the frames; every key but the title is optional."""

    title: Required[str]
    estimate: tuple[float, float]  # x_mm, theta_deg
    correction: tuple[float, float]  # dx_mm, dtheta_deg
    interval: tuple[tuple[float, float], tuple[float, float]]  # 90 %: (x low, high), (theta low, high)
    direction: Sequence[Sequence[float]]  # probabilities: left, middle, right; anticlockwise, straight, clockwise
    notes: Sequence[str]


def save(path: Path, frames: NDArray[np.uint8], decision: Decision, motion: Motion, valid: NDArray[np.bool_]) -> Path:
    """Draw an attempt into a PNG at ``path``; its folder is created.

    ``frames`` uint8 [n, 2, H, W, 3] BGR rectified, first to last; ``motion`` of the markers from the first to the last
    frame is drawn as arrows; ``valid`` bool [2, rows, cols].
    Raises ValueError on another shape of frames.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if frames.ndim != 5 or frames.shape[1] != 2 or frames.shape[-1] != 3 or not len(frames):
        raise ValueError(f"frames have shape {list(frames.shape)}, expected [n, 2, height, width, 3]")
    figure = Figure(figsize=(15, 8.4), dpi=100, layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=(1.35, 1.0))
    upper, lower = parts
    left, right, facts = upper.subplots(1, 3, width_ratios=(1, 1, 0.95))
    for finger, axes in enumerate((left, right)):
        moved = motion[0][finger], motion[1][finger]
        imprint(axes, frames[-1, finger], _FINGER_NAMES[finger], moved, valid[finger])
    _facts(facts, decision)
    _differences(lower, frames)
    figure.suptitle(decision["title"])
    path.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure).print_png(str(path))
    return path


def imprint(
    axes: Any, frame: NDArray[np.uint8], caption: str, motion: Motion, valid: NDArray[np.bool_] | None = None
) -> None:
    """One rectified frame [H, W, 3] on ``axes`` with one finger's marker motion as arrows."""
    axes.imshow(frame[..., ::-1])
    axes.set_axis_off()
    rest, moved = motion[0], np.asarray(motion[1], float)
    shown = np.isfinite(moved).all(-1) & (True if valid is None else valid)
    start, step = rest[shown], moved[shown] * ARROW_SCALE
    style = {"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.004, "color": "yellow"}
    axes.quiver(start[:, 0], start[:, 1], step[:, 0], step[:, 1], **style)
    largest = float(np.linalg.norm(moved[shown], axis=-1).max(initial=0.0))
    axes.set_title(f"{caption}  markers moved up to {largest:.1f} px (arrows x{ARROW_SCALE:g})", fontsize=9)


def _differences(figure: Any, frames: NDArray[np.uint8]) -> None:
    """One row per finger: later frames, at most 8, minus the first; grey is no change. Nothing for a single frame."""
    last = len(frames) - 1
    if not last:
        return
    shown = np.linspace(1, last, min(last, 8)).round().astype(int)
    grid = figure.subplots(2, len(shown), squeeze=False)
    for finger in range(2):
        for axes, number in zip(grid[finger], shown, strict=True):
            change = frames[number, finger].astype(np.int16) - frames[0, finger]
            axes.imshow(np.clip(128 + 2 * change, 0, 255).astype(np.uint8)[..., ::-1])
            axes.set_xticks([])
            axes.set_yticks([])
            if finger == 0:
                axes.set_title(f"frame {number + 1} - frame 1", fontsize=8)
        grid[finger, 0].set_ylabel(("left", "right")[finger], fontsize=8)


def _facts(axes: Any, decision: Decision) -> None:
    """Numbers above, the direction of the error as a grid of probabilities below."""
    direction = decision.get("direction")
    axes.set_title("no decision" if direction is None and "estimate" not in decision else "decision", fontsize=9)
    axes.set_axis_off()
    axes.text(0.03, 0.97, "\n".join(fact_lines(decision)), transform=axes.transAxes, va="top", family="monospace")
    if direction is not None:
        _direction(axes.inset_axes((0.3, 0.02, 0.6, 0.42)), np.asarray(direction, float))


def _direction(axes: Any, shares: NDArray[np.floating]) -> None:
    """A grid of three columns (the object's position) and three rows (its yaw)."""
    axes.imshow(shares, cmap="Greens", vmin=0.0, vmax=1.0, aspect="auto")
    axes.set_xticks(range(3), ("left", "in line", "right"), fontsize=8)
    axes.set_yticks(range(3), ("anticlockwise", "straight", "clockwise"), fontsize=8)
    axes.set_title("where the object stands, seen from above", fontsize=8)
    for row, column in np.argwhere(shares >= 0.005):
        share = shares[row, column]
        axes.text(column, row, f"{share:.0%}", ha="center", va="center", color="white" if share > 0.5 else "black")


def fact_lines(decision: Decision) -> list[str]:
    """The numbers of a decision, one per line, with units."""
    lines = []
    if "estimate" in decision:
        lines.append(_pair("estimate", decision["estimate"]))
    if "interval" in decision:
        (x_low, x_high), (theta_low, theta_high) = decision["interval"]
        lines.append(_columns("90 %", f"{x_low:+.1f}..{x_high:+.1f}", f"{theta_low:+.1f}..{theta_high:+.1f}"))
    if "correction" in decision:
        lines.append(_pair("correction", decision["correction"]))
    return [*lines, *decision.get("notes", ())]


def _pair(what: str, values: tuple[float, float]) -> str:
    return _columns(what, f"{values[0]:+.2f}", f"{values[1]:+.2f}")


def _columns(what: str, x_mm: str, theta_deg: str) -> str:
    return f"{what:<10} {x_mm:>12} mm {theta_deg:>12} deg"
