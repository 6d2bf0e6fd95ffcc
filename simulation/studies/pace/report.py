"""The page of seconds a box: each choice of settings against what ships, on the same starts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reporting.figure import BLUE, GREEN, GREY, ORANGE, PALETTE, drawing
from reporting.page import page, publish
from reporting.statistics import Estimate, bootstrap, mean, wilson
from reporting.table import Table, table
from simulation.closed_loop.statistics import Row
from simulation.studies.pace.points import BEFORE, SHIPPED, Point

NAME = "pace"
DRAWS = 2000
LIVE = """
## Beside a live insertion

Lock step counts no way of a frame through camera, network and perception. The rectangle was inserted live on a machine
with seven busy programs on two cores, the simulated cell among them. As shipped with cameras of 30 frames a second: two
of two, without a pause. The quick choice with 60: three of three, where the lease paused the fast legs 17 to 41 times.
From one start (4.8 mm, 4.4 deg) that is 8.6 s and three attempts as shipped, 5.0 s and two attempts with the quick one.
An earlier quick choice, probing at 15 mm/s, had inserted one of four on such a machine, and was held unwatched in the
others. `pauses` in the arm's statistics counts: leave such legs out where there are more than a few.

The client prints the same parts at the end of every insertion, and keeps them in its log. `python -m simulation run
--client pace.toml` plays a choice live.
"""
AIR, PROBING, FAST, TRIP = "in the air", "probing, stop, look", "fast legs", "trip to the fixture"
GROUPS = {
    "approach": AIR,
    "arm": PROBING,
    "fast descent": FAST,
    "guarded descent": PROBING,
    "stop": PROBING,
    "wait for frames": PROBING,
    "decide": PROBING,
    "retract": AIR,
    "correct": AIR,
    "confirm": PROBING,
    "take afresh": TRIP,
}
COLOURS = {AIR: PALETTE[5], PROBING: ORANGE, FAST: GREEN, TRIP: PALETTE[4]}


def report_of(rows: Sequence[Row], points: Sequence[Point]) -> Row:
    """What the page and its figure are written from, as plain data; every point has the same starts."""
    by_name = {point.name: [row for row in rows if row["condition"] == point.name] for point in points}
    first = by_name[points[0].name]
    return {"insertions": len(first), "points": [_point(point, by_name[point.name], first) for point in points]}


def _point(point: Point, rows: Sequence[Row], first: Sequence[Row]) -> Row:
    totals, forces = np.array([total_s(row) for row in rows]), [row["course"]["force_n"] for row in rows]
    frames = [trial["frames_s"] for row in rows for trial in row["trials"] if trial["frames_s"] is not None]
    harder = [force - before["course"]["force_n"] for force, before in zip(forces, first, strict=True)]
    return {
        "name": point.name,
        "client": point.client,
        "inserted": sum(row["inserted"] for row in rows),
        "gained": sum(row["inserted"] > before["inserted"] for row, before in zip(rows, first, strict=True)),
        "lost": sum(row["inserted"] < before["inserted"] for row, before in zip(rows, first, strict=True)),
        "claimed_wrongly": sum(row["claimed"] and not row["inserted"] for row in rows),
        "attempts": float(np.mean([row["attempts"] for row in rows])),
        "trips": float(np.mean([row["grasps"] - 1 for row in rows])),
        "seconds_a_box": list(_a_box(rows)),
        "faster": list(_faster(rows, first)),
        "seconds": _spread(totals),
        "parts": {part: _spread([row["seconds"][part] for row in rows]) for part in rows[0]["seconds"]},
        "force_n": _spread(forces) | {"largest": max(forces)},
        "harder_n": list(mean(harder)),
        "unseen_mm": max(row["unseen_mm"] for row in rows),
        "unseen_too_far": sum(row["unseen_mm"] > row["unseen_allowed_mm"] + 1e-6 for row in rows),
        "frames_s": _spread(frames) if frames else None,
    }


def total_s(row: Row) -> float:
    """Seconds of an insertion."""
    return float(sum(row["seconds"].values()))


def _spread(values: Sequence[float] | NDArray[np.float64]) -> dict[str, float]:
    return {
        "mean": float(np.mean(values)),
        "median": float(np.median(values)),
        "95": float(np.quantile(values, 0.95)),
    }


def _sums(rows: Sequence[Row]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Seconds and boxes of resampled starts [DRAWS], the same starts for every point; the first draw is all."""
    draws = np.random.default_rng(0).integers(0, len(rows), (DRAWS, len(rows)))
    draws[0] = np.arange(len(rows))
    seconds, boxes = np.array([total_s(row) for row in rows]), np.array([float(row["inserted"]) for row in rows])
    return seconds[draws].sum(1), np.maximum(boxes[draws].sum(1), 0.5)


def _a_box(rows: Sequence[Row]) -> Estimate:
    seconds, boxes = _sums(rows)
    each = seconds / boxes
    return bootstrap(float(each[0]), each.tolist())


def _faster(rows: Sequence[Row], first: Sequence[Row]) -> Estimate:
    (seconds, boxes), (first_seconds, first_boxes) = _sums(rows), _sums(first)
    ratio = (first_seconds / first_boxes) / (seconds / boxes)
    return bootstrap(float(ratio[0]), ratio.tolist())


def front(points: Sequence[Row]) -> set[str]:
    """Names of the points that no other beats in seconds a box, in force or in boxes without losing in another."""

    def merits(point: Row) -> tuple[float, float, int, int]:
        wrong = -point["claimed_wrongly"]
        return -point["seconds_a_box"][0], -point["force_n"]["95"], point["inserted"], wrong

    def beaten(point: Row) -> bool:
        mine = merits(point)
        return any(
            other is not point
            and all(a >= b for a, b in zip(merits(other), mine, strict=True))
            and merits(other) != mine
            for other in points
        )

    return {point["name"] for point in points if not beaten(point)}


def columns(data: Row, best: set[str]) -> Table:
    """The table of all choices; those on the front are bold."""
    count = data["insertions"]
    return table(
        data["points"],
        ("settings", lambda p: f"**{p['name']}**" if p["name"] in best else p["name"]),
        ("seconds a box", "seconds_a_box", ".1f"),
        ("times faster", "faster", ".2f"),
        ("median s", "seconds.median", ".1f"),
        ("95 % s", "seconds.95", ".1f"),
        ("inserted", lambda p: wilson(p["inserted"], count), ".0%"),
        ("gained, lost", lambda p: f"{p['gained']}, {p['lost']}"),
        ("false claims", "claimed_wrongly", "d"),
        ("attempts", "attempts", ".2f"),
        ("trips", "trips", ".2f"),
        ("force 95 %, N", "force_n.95", ".1f"),
        ("largest N", "force_n.largest", ".1f"),
        ("harder, N", "harder_n", "+.1f"),
        ("unseen, mm", "unseen_mm", ".2f"),
    )


def parts(data: Row) -> Table:
    """Where the seconds go: means; median and 95 % of the whole are in the other table."""
    names = [name for name in GROUPS if any(p["parts"][name]["mean"] >= 0.005 for p in data["points"])]
    return table(
        data["points"],
        ("settings", "name"),
        *((name, lambda p, name=name: p["parts"][name]["mean"], ".2f") for name in names),
        ("touch to last frame", lambda p: p["frames_s"] and p["frames_s"]["mean"], ".2f"),
    )


def draw(data: Row, path: Path) -> None:
    """Seconds against force, and where they go."""
    points = data["points"]
    with drawing(path, 1, 2, size=(13, 0.45 * len(points) + 2.2), width_ratios=(4, 5), sharey=True) as axes:
        _draw_cost(axes[0, 0], points, front(points))
        _draw_parts(axes[0, 1], points)


def _draw_cost(panel: Any, points: Sequence[Row], best: set[str]) -> None:
    """A line a choice: its seconds with their interval, and its force in words."""
    for place, point in enumerate(points):
        value, low, high = point["seconds_a_box"]
        colour = BLUE if point["name"] in best else GREY
        panel.errorbar(value, place, xerr=[[value - low], [high - value]], fmt="o", color=colour, capsize=2)
        text = f"{value:.1f} s, {point['force_n']['95']:.0f} N"
        panel.text(value, place - 0.2, text, color=colour, fontsize=7, ha="center", va="bottom")
    panel.set_yticks(range(len(points)), [point["name"] for point in points], fontsize=8)
    panel.invert_yaxis()
    panel.set(xlim=(0, None), xlabel="seconds a box, 95 % interval")
    panel.set_title("what it costs, and the force that 95 % stay below; blue: on the front")


def _draw_parts(panel: Any, points: Sequence[Row]) -> None:
    left = np.zeros(len(points))
    for name, colour in COLOURS.items():
        width = np.array([sum(of["mean"] for part, of in p["parts"].items() if GROUPS[part] == name) for p in points])
        panel.barh(np.arange(len(points)), width, left=left, color=colour, height=0.6)
        for place in np.flatnonzero(width >= 0.5):
            text = f"{name}\n{width[place]:.1f}" if place == np.argmax(width) else f"{width[place]:.1f}"
            panel.text(left[place] + width[place] / 2, place, text, ha="center", va="center", fontsize=7)
        left += width
    panel.set(xlim=(0, None), xlabel="mean seconds of an insertion", title="where they go")


def pace_page(data: Row) -> str:
    """The whole of docs/pace.md from pace.json."""
    of = {point["name"]: point for point in data["points"]}
    return page(
        f"""
        # What accuracy costs, in seconds a box

        Written by `make pace`. Everything is simulated: {data["insertions"]} insertions a choice in drawn worlds with
        drawn objects (seed {data["seed"]}, bristle tier; no choice was made on them), in lock step, through the
        service's session and the client's own state machine, ramps and leases. A box begins 30 mm above the approach
        and ends when the insertion is confirmed or given up. *Seconds a box* are all seconds over all boxes inserted,
        so a failure costs what it took. All choices begin from the same starts; intervals are of 95 % (bootstrap over
        starts, Wilson's for shares). **Bold**: no other choice is better in one of seconds, force, boxes and false
        claims and as good in the rest.
        """,
        f"![cost and force of each choice, and where the seconds go]({NAME}.png)",
        columns(data, front(data["points"])),
        f"""
        *Times faster*, *gained, lost* (boxes) and *harder* (mean difference of the largest force, N) are against
        *{BEFORE}*, start by start. *Trips*: how often a part that may have [turned in the
        hand](decisions/0112-an-object-that-has-turned-is-taken-afresh.md) was taken afresh, 300 mm away. *Unseen*: the
        furthest that the arm went down after the capture of a judged frame before the next one was; no choice went
        beyond its lease.
        """
        if not any(point["unseen_too_far"] for point in data["points"])
        else "**A choice went further unseen than its lease allows.**",
        "Mean seconds by what was waited for:",
        parts(data),
        _choices(of),
        LIVE,
    )


def _choices(of: Row) -> str:
    """What ships and why, with the figures that it rests on."""
    before, shipped = of[BEFORE], of[SHIPPED]
    faster = Estimate(*shipped["faster"])
    return f"""
    ## What ships, and why

    **Shipped settings need {faster:.2f} times fewer seconds a box than those before**, and touch more gently: the
    largest force of an insertion is {-shipped["harder_n"][0]:.1f} N lower in the mean.

    **Probing speed**: {shipped["client"]["ramps"]["descend"]["speed_mm_s"]:g} mm/s around the blocks' tops,
    {shipped["client"]["pace"]["fast_mm_s"]:g} mm/s above and below. Slower is quicker here: what turns a part in the
    hand is the way that the arm goes on after its contact, and a trip to the fixture costs more than all that a
    quicker touch saves. There are {shipped["trips"]:.2f} trips a box instead of {before["trips"]:.2f}. The legs outside
    the band are no faster than the whole descent was before, on the same lease of 1.5 mm. Arms that have one speed, and
    cells whose cameras do not bear the legs, probe all the way.

    **Travel**: 80 mm/s, which the limits have always allowed; a turn keeps to 55 deg/s. **Lift**: 3 mm above the
    highest height at which an attempt was stopped, for no part that is upright to 2 deg reaches lower than that.

    **Not shipped**: legs of 25 mm/s need cameras of 38 frames a second and a PC that judges every one of them;
    120 mm/s in the air need an arm that follows its targets within 83 ms; harder ramps were never told
    apart from the slow ones on a live cell. `choose` writes them; try them on your cell before you trust them:

    <!-- not executed: writes pace.toml -->
    ```sh
    python -m simulation choose --seconds-a-box 12.5 --success 0.9 --max-force 40
    ```

    **Frames a decision**: nothing is waited for after standstill. From the touch to the last frame that a decision
    reads pass {shipped["frames_s"]["mean"]:.2f} s, because networks stop the arm when they have seen
    enough; [why not sooner](decisions/0079-the-depth-of-a-decision.md).

    **Why it is so**: [slow around the tops](decisions/0154-slow-around-the-tops.md), [why a descent may change its
    speed](decisions/0104-a-descent-at-two-speeds.md).
    """


def write(data: Row, docs: Path) -> str:
    """Write NAME.md, .json and .png into the folder; returns the text."""
    docs.mkdir(parents=True, exist_ok=True)
    draw(data, docs / f"{NAME}.png")
    return publish(docs, NAME, pace_page(data), data)
