"""The closed-loop report: Table I with the paper's row beside ours, what limits us, pictures, JSON. All simulated."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from simulation.closed_loop.baselines import CONTROLLERS
from simulation.closed_loop.figures import draw_confusion, draw_scatter
from simulation.closed_loop.statistics import Row, estimates, in_order, summarise, title_of, wilson
from simulation.scene.parts import Figures
from simulation.scene.worlds import known_object

NAME = "closed_loop"
_PAPER_HEAD = (
    "| object | inserted (simulated) | 95 % interval | mean trials | max | target |"
    " paper (real robot): success, mean, max | blocks < 1 mm | worst tilt | grasp kept | worst slip in hand |"
)
_LIMIT_HEAD = (
    "| object | short of the target by | oracle step | first estimate: RMSE x, theta | x error in its own sigmas |"
    " wrong side | limited by |"
)


def write(rows: list[Row], setup: Mapping[str, str], docs: Path, note: str = "") -> str:
    """Write NAME.md, NAME.json and the pictures into the folder; returns the text."""
    docs.mkdir(parents=True, exist_ok=True)
    summaries = summarise(rows)
    text = report(rows, summaries, note)
    if (docs / f"{NAME}_filmstrip.png").exists():
        text += f"\nOne insertion, every frame drawn and tracked:\n\n![one insertion]({NAME}_filmstrip.png)\n"
    (docs / f"{NAME}.md").write_text(text, encoding="utf-8")
    networks = {name: _networks(rows, name) for name in ("belief", "joint", "paper")}
    data = {"simulated": True, "setup": dict(setup), "summaries": summaries, "first_estimates": networks}
    (docs / f"{NAME}.json").write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    draw_scatter(rows, docs / f"{NAME}_trials.png")
    draw_confusion([row for row in rows if row["controller"] == "belief"], docs / f"{NAME}_confusion.png")
    return text


def _networks(rows: list[Row], controller: str) -> dict[str, Any]:
    """First estimates by object; heuristic and belief are given the same frames in a first attempt."""
    mine = [row for row in rows if row["controller"] == controller]
    scenes = in_order(row["scene"] for row in mine)
    first = {title_of(scene): estimates([row for row in mine if row["scene"] == scene]) for scene in scenes}
    return {name: value for name, value in first.items() if value}


def report(rows: list[Row], summaries: Sequence[Row], note: str = "") -> str:
    """The report as Markdown."""
    largest = max(row["insertions"] for row in summaries)
    perception = sorted({row["perception"] for row in summaries if CONTROLLERS[row["controller"]].uses_networks})
    parts = [
        "# The closed loop, simulated",
        "",
        "Written by `make evaluate`. Every figure but the paper's is simulated: free blocks, at most 15 trials, a",
        "failure counts as 16, start errors uniform in the range of each object plus its four extremes, frames through",
        "the service's session and ONNX files, answers through the robot client's state machine.",
        f"Up to {largest} insertions an object; 95 % Wilson intervals. {_perception(perception)}",
        *(["", note] if note else []),
        "",
        "## Table I beside the paper's",
        "",
        *paper_table(summaries),
        "",
        "Blocks count as unmoved below 1 mm at any time of the insertion. Slip in hand is what was left of the",
        "object's displacement in the grasp once it hung free again.",
        "",
        f"![number of trials over the start error]({NAME}_trials.png)",
        "",
        "## Baselines",
        "",
        *baseline_table(summaries, on_shared_starts(rows)),
        "",
        "## What limits it",
        "",
        *limits(rows, summaries),
        "",
        f"![direction classes]({NAME}_confusion.png)",
        "",
    ]
    return "\n".join(parts)


def _perception(kinds: Sequence[str]) -> str:
    if kinds == ["fields"]:
        return (
            "Slip is detected on the true marker field plus the tracker's measured error;"
            " networks that read markers read the same, those that read pictures read frames drawn and rectified."
        )
    return "Every frame is drawn, rectified and tracked."


def paper_table(summaries: Sequence[Row]) -> list[str]:
    """The belief controller beside the paper's Table I and our targets, an object a line."""
    lines = [
        _PAPER_HEAD,
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in (row for row in summaries if row["controller"] == "belief"):
        known = known_object(row["scene"])
        target, paper = (_target(known.target), _paper(known.paper)) if known else ("", "")
        lines.append(
            f"| {title_of(row['scene'])} | {_share(row)} | {_interval(row['success_interval'])} | {_trials(row)} |"
            f" {_most(row['max_trials'])} | {target} | {paper} |"
            f" {row['blocks_under_1_mm']:.1%} | {row['worst_block_tilt_deg']:.2f} deg | {row['grasp_kept']:.1%} |"
            f" {row['worst_slip_in_hand_mm']:.1f} mm |"
        )
    return lines


def _target(figures: Figures | None) -> str:
    return f"{figures.success:.0%}, {figures.mean_trials:g}" if figures else ""


def _paper(figures: Figures | None) -> str:
    if figures is None:
        return ""
    most = f", {_most(figures.max_trials)}" if figures.max_trials else ""
    return f"{100.0 * figures.success:g} %, {figures.mean_trials:g}{most}"


def on_shared_starts(rows: list[Row]) -> list[Row]:
    """Summaries of the belief on the starts that others played too; none if those are all of its own.

    The four extremes come first and never insert at once: a row of few insertions holds a larger share of them.
    """
    theirs = {(row["scene"], row["index"]) for row in rows if row["controller"] != "belief"}
    mine = [row for row in rows if row["controller"] == "belief"]
    shared = [row for row in mine if (row["scene"], row["index"]) in theirs]
    return summarise(shared) if len(shared) < len(mine) else []


def baseline_table(summaries: Sequence[Row], shared: Sequence[Row] = ()) -> list[str]:
    """Success and mean trials, controller by object; ``shared`` is the belief where others played, too."""
    scenes = in_order(row["scene"] for row in summaries)
    names = " | ".join(title_of(scene) for scene in scenes)
    head = f"| controller (insertions in all) | {names} | all together, 95 % interval |"
    lines = [head, "|---" * (len(scenes) + 2) + "|"]
    for name, controller in CONTROLLERS.items():
        lines += _controller_row(controller.title, scenes, [row for row in summaries if row["controller"] == name])
        if name == "belief":
            lines += _controller_row(f"{controller.title}, on the starts of the rows below", scenes, shared)
    return lines


def _controller_row(title: str, scenes: Sequence[str], rows: Sequence[Row]) -> list[str]:
    if not rows:
        return []
    mine = {row["scene"]: row for row in rows}
    cells = [f"{_round(m['success'])}, {_trials(m)}" if (m := mine.get(name)) else "" for name in scenes]
    count = sum(row["insertions"] for row in rows)
    return [f"| {title} ({count}) | " + " | ".join(cells) + f" | {_together(rows)} |"]


def _together(rows: Iterable[Row]) -> str:
    """All objects in one: success, its interval, mean trials, weighted by insertions."""
    listed = list(rows)
    count, inserted = (sum(row[name] for row in listed) for name in ("insertions", "inserted"))
    trials = sum(row["mean_trials"] * row["insertions"] for row in listed) / count
    return f"{_round(inserted / count)} ({_interval(wilson(inserted, count))}), {trials:.2f}"


def limits(rows: list[Row], summaries: Sequence[Row]) -> list[str]:
    """Where a figure falls short: by how much, and whether the oracle, the networks or the controller limits it."""
    of = {(row["controller"], row["scene"]): row for row in summaries}
    lines = [
        _LIMIT_HEAD,
        "|---|---|---|---|---|---|---|",
    ]
    for scene in in_order(row["scene"] for row in summaries):
        ours, oracle = of.get(("belief", scene)), of.get(("oracle", scene))
        first = estimates([row for row in rows if row["scene"] == scene and row["controller"] == "belief"])
        if ours is None or first is None:
            continue
        error = f"{first['rmse_x_mm']:.1f} mm, {first['rmse_theta_deg']:.1f} deg"
        best = f"{_round(oracle['success'])}, {_trials(oracle)}" if oracle else ""
        lines.append(
            f"| {title_of(scene)} | {_short(ours)} | {best} | {error} | {first['x_errors_in_sigmas']:.1f} |"
            f" {first['wrong_side_x']:.1%} | {_limit(ours, oracle, first)} |"
        )
    void = sum(row["void"] for row in summaries)
    wrong = sum(row["claimed_wrongly"] for row in summaries if row["controller"] == "belief")
    return [
        *lines,
        "",
        f"Void, the physics came to its end (no equilibrium, or an object pushed 12 mm up in the hand): {void}.",
        f"Insertions that the client took for done and were not (belief): {wrong}.",
    ]


def _short(row: Row) -> str:
    known = known_object(row["scene"])
    if known is None or known.target is None:
        return ""
    target, gaps = known.target, []
    if row["success"] < target.success:
        gaps.append(f"{100 * (target.success - row['success']):.1f} points of success")
    if row["mean_trials"] > target.mean_trials:
        gaps.append(f"{row['mean_trials'] - target.mean_trials:.2f} trials")
    return ", ".join(gaps) or "nothing"


def _limit(ours: Row, oracle: Row | None, first: Row) -> str:
    """The first of oracle, perception, controller that alone explains a shortfall."""
    if _short(ours) in {"", "nothing"}:
        return ""
    if oracle and _short(oracle) != "nothing":
        return "the protocol itself: the oracle falls short too"
    if first["x_errors_in_sigmas"] > 1.5 or first["rmse_x_mm"] > 2.5:
        return "perception: the first estimates are further off than they claim"
    return "controller"


def _share(row: Row) -> str:
    return f"{row['inserted']}/{row['insertions']} = {row['success']:.1%}"


def _round(share: float) -> str:
    """Whole per cent; 100 % only where all were inserted."""
    return f"{share:.0%}" if share == 1.0 or share < 0.995 else f"{math.floor(1000 * share) / 10:.1f}%"


def _interval(ends: Sequence[float]) -> str:
    return f"{ends[0]:.1%} .. {ends[1]:.1%}"


def _trials(row: Row) -> str:
    error = row["mean_trials_standard_error"]
    return f"{row['mean_trials']:.2f}" + (f" +- {error:.2f}" if error is not None else "")


def _most(trials: int) -> str:
    return ">15" if trials > 15 else str(trials)
