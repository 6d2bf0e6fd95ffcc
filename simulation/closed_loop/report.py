"""The closed-loop report: Table I with the paper's row beside ours, what limits us, figures, JSON. All simulated."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from reporting.page import page, publish
from reporting.statistics import Estimate, number, wilson
from reporting.table import Table, table
from simulation.closed_loop.baselines import CONTROLLERS
from simulation.closed_loop.figures import draw_confusion, draw_scatter
from simulation.closed_loop.statistics import Row, estimates, in_order, summarise, title_of
from simulation.scene.parts import Figures
from simulation.scene.worlds import known_object

NAME = "closed_loop"
FIELDS = """
    Slip is detected on the true marker field plus the tracker's measured error. Networks that read markers read the
    same field; those that read pictures read frames drawn and rectified.
    """


def write(rows: list[Row], setup: Mapping[str, str], docs: Path, note: str = "") -> str:
    """Write NAME.md, NAME.json and the figures into the folder; returns the text."""
    data = report_of(rows, setup, note) | {"filmstrip": (docs / f"{NAME}_filmstrip.png").exists()}
    draw_scatter(rows, docs / f"{NAME}_trials.png")
    draw_confusion([row for row in rows if row["controller"] == "belief"], docs / f"{NAME}_confusion.png")
    return publish(docs, NAME, closed_loop_page(data), data)


def report_of(rows: list[Row], setup: Mapping[str, str], note: str = "") -> Row:
    """What the page is written from, as plain data."""
    return {
        "simulated": True,
        "setup": dict(setup),
        "note": note,
        "summaries": summarise(rows),
        "shared_starts": on_shared_starts(rows),
        "first_estimates": {name: _networks(rows, name) for name in ("belief", "joint", "paper")},
    }


def _networks(rows: list[Row], controller: str) -> dict[str, Any]:
    """First estimates by object; heuristic and belief are given the same frames in a first attempt."""
    mine = [row for row in rows if row["controller"] == controller]
    scenes = in_order(row["scene"] for row in mine)
    first = {title_of(scene): estimates([row for row in mine if row["scene"] == scene]) for scene in scenes}
    return {name: value for name, value in first.items() if value}


def on_shared_starts(rows: list[Row]) -> list[Row]:
    """Summaries of the belief on the starts that others played too; none if those are all of its own.

    The four extremes come first and never insert at once: a row of few insertions holds a larger share of them.
    """
    theirs = {(row["scene"], row["index"]) for row in rows if row["controller"] != "belief"}
    mine = [row for row in rows if row["controller"] == "belief"]
    shared = [row for row in mine if (row["scene"], row["index"]) in theirs]
    return summarise(shared) if len(shared) < len(mine) else []


def closed_loop_page(data: Row) -> str:
    """The whole of docs/closed_loop.md from closed_loop.json."""
    summaries, first = data["summaries"], data["first_estimates"]["belief"]
    drawn = {row["perception"] for row in summaries if CONTROLLERS[row["controller"]].uses_networks} != {"fields"}
    return page(
        f"""
        # The closed loop, simulated

        Written by `make evaluate`. Every figure but the paper's is simulated. Blocks are free, an insertion has at most
        15 trials, and a failure counts as 16. Start errors are the four extremes and uniform errors in the range of
        each object. Frames go through the service's session and ONNX files, answers through the robot client's state
        machine. Up to {max(row["insertions"] for row in summaries)} insertions an object; shares have their 95 % Wilson
        intervals, mean trials their standard errors.
        """,
        "Every frame is drawn, rectified and tracked." if drawn else FIELDS,
        data["note"],
        "## Table I beside the paper's",
        _paper_table([row for row in summaries if row["controller"] == "belief"]),
        f"""
        Blocks count as unmoved below 1 mm at any time of the insertion. Slip in hand is what was left of the object's
        displacement in the grasp once it hung free again.

        ![number of trials over the start error]({NAME}_trials.png)

        ## Baselines
        """,
        baseline_table(summaries, data["shared_starts"]),
        "## What limits it",
        *_limits(summaries, first),
        f"![direction classes]({NAME}_confusion.png)",
        f"One insertion, every frame drawn and tracked:\n\n![one insertion]({NAME}_filmstrip.png)"
        if data.get("filmstrip")
        else "",
    )


def _paper_table(rows: Sequence[Row]) -> Table:
    """The belief controller beside the paper's Table I and our targets, an object a line."""
    return table(
        rows,
        ("object", lambda row: title_of(row["scene"])),
        ("inserted (simulated)", lambda row: f"{row['inserted']}/{row['insertions']}"),
        ("success", lambda row: Estimate(row["success"], *row["success_interval"]), ".1%"),
        ("mean trials", _trials),
        ("max", lambda row: _most(row["max_trials"])),
        ("target", lambda row: _figures(row, "target")),
        ("paper (real robot): success, mean, max", lambda row: _figures(row, "paper")),
        ("blocks < 1 mm", "blocks_under_1_mm", ".1%"),
        ("worst tilt, deg", "worst_block_tilt_deg", ".2f"),
        ("grasp kept", "grasp_kept", ".1%"),
        ("worst slip in hand, mm", "worst_slip_in_hand_mm", ".1f"),
    )


def _figures(row: Row, of: str) -> str:
    figures: Figures | None = getattr(known_object(row["scene"]), of, None)
    if figures is None:
        return ""
    most = f", {_most(figures.max_trials)}" if figures.max_trials else ""
    return f"{100.0 * figures.success:g} %, {figures.mean_trials:g}{most}"


def baseline_table(summaries: Sequence[Row], shared: Sequence[Row] = ()) -> Table:
    """Success and mean trials, controller by object; ``shared`` is the belief where others played, too."""
    lines: list[tuple[str, Sequence[Row]]] = []
    for name, controller in CONTROLLERS.items():
        lines.append((controller.title, [row for row in summaries if row["controller"] == name]))
        if name == "belief":
            lines.append((f"{controller.title}, on the starts of the rows below", shared))

    def cell(scene: str) -> Any:
        return lambda line: next((_reached(row) for row in line[1] if row["scene"] == scene), "")

    return table(
        [line for line in lines if line[1]],
        ("controller (insertions)", lambda line: f"{line[0]} ({sum(row['insertions'] for row in line[1])})"),
        *((title_of(scene), cell(scene)) for scene in in_order(row["scene"] for row in summaries)),
        ("all together", lambda line: _together(line[1])),
    )


def _together(rows: Sequence[Row]) -> str:
    """All objects in one: success with its interval, mean trials, weighted by insertions."""
    count, inserted = (sum(row[name] for row in rows) for name in ("insertions", "inserted"))
    trials = sum(row["mean_trials"] * row["insertions"] for row in rows) / count
    return f"{wilson(inserted, count):.1%}, {trials:.2f}"


def _limits(summaries: Sequence[Row], first: Mapping[str, Row]) -> Iterator[str | Table]:
    """Where a figure falls short: by how much, and whether the oracle, the networks or the controller limits it."""
    oracle = {row["scene"]: row for row in summaries if row["controller"] == "oracle"}
    ours = [row for row in summaries if row["controller"] == "belief" and title_of(row["scene"]) in first]
    lines = [(row, oracle.get(row["scene"]), first[title_of(row["scene"])]) for row in ours]
    yield table(
        lines,
        ("object", lambda line: title_of(line[0]["scene"])),
        ("short of the target by", lambda line: _short(line[0])),
        ("oracle step", lambda line: _reached(line[1]) if line[1] else ""),
        ("first estimate: RMSE x mm", "2.rmse_x_mm", ".1f"),
        ("theta deg", "2.rmse_theta_deg", ".1f"),
        ("x error in its own sigmas", "2.x_errors_in_sigmas", ".1f"),
        ("wrong side", "2.wrong_side_x", ".1%"),
        ("limited by", lambda line: _limit(*line)),
    )
    void = sum(row["void"] for row in summaries)
    wrong = sum(row["claimed_wrongly"] for row in summaries if row["controller"] == "belief")
    yield f"""
        Void, because the physics came to its end (no equilibrium, or an object pushed 12 mm up in the hand): {void}.
        Insertions that the client took for done and were not (belief): {wrong}.
        """


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


def _reached(row: Row) -> str:
    """Success in whole per cent, 100 % only where all were inserted, and mean trials."""
    share = row["success"]
    near = 0.995 <= share < 1.0
    return f"{number(math.floor(1000 * share) / 1000 if near else share, '.1%' if near else '.0%')}, {_trials(row)}"


def _trials(row: Row) -> str:
    error = row["mean_trials_standard_error"]
    return f"{row['mean_trials']:.2f}" + (f" +- {error:.2f}" if error is not None else "")


def _most(trials: int) -> str:
    return ">15" if trials > 15 else str(trials)
