"""The page of seconds a box: each choice of settings against what ships, on the same starts."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reporting.page import page, publish
from reporting.statistics import Estimate, mean, number, wilson
from reporting.table import Table, table
from simulation.closed_loop.statistics import Row
from simulation.studies.pace.figures import EARLY, figures
from simulation.studies.pace.panels import draw, write_html
from simulation.studies.pace.points import BEFORE, SHIPPED, Point
from simulation.studies.pace.resampled import a_box, faster, total_s, upper

NAME = "pace"
WANTED = 1.8  # times fewer seconds a box than before
BESIDES = """
**Why it is so**: [slow around the tops](decisions/0154-slow-around-the-tops.md), [why a descent may change its
speed](decisions/0104-a-descent-at-two-speeds.md), [when a turn is
known](decisions/0155-standing-still-is-no-sliding.md).

## Beside a live insertion

Lock step counts no way of a frame through camera, network and perception. The rectangle was inserted live on a machine
with seven busy programs on two cores, the simulated cell among them. As shipped with cameras of 30 frames a second: two
of two, without a pause. The quick choice with 60: three of three, where the lease paused the fast legs 17 to 41 times.
From one start (4.8 mm, 4.4 deg) that is 8.6 s and three attempts as shipped, 5.0 s and two attempts with the quick one.
An earlier quick choice, probing at 15 mm/s, had inserted one of four on such a machine, and was held unwatched in the
others. `pauses` in the arm's statistics counts: leave such legs out where there are more than a few.

The client prints the same parts at the end of every insertion, and keeps them in its log. `python -m simulation run
--client pace.toml` plays a choice live.

## More than one cell

What one, two and four cells take of one PC, and what a fleet of 100 comes to in recordings, bandwidth and adaptation,
is measured and worked out in [what serving costs](serving.md). What a second process saves in collection and training
is in [several cells](deployment.md#several-cells).
"""


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
        "service": dict(point.service),
        "needs": point.needs,
        "inserted": sum(row["inserted"] for row in rows),
        "gained": sum(row["inserted"] > before["inserted"] for row, before in zip(rows, first, strict=True)),
        "lost": sum(row["inserted"] < before["inserted"] for row, before in zip(rows, first, strict=True)),
        "claimed_wrongly": sum(row["claimed"] and not row["inserted"] for row in rows),
        "untrue": [[row["index"], *row["shortfalls"]] for row in rows if row["claimed"] and not row["inserted"]],
        "attempts": float(np.mean([row["attempts"] for row in rows])),
        "trips": float(np.mean([row["grasps"] - 1 for row in rows])),
        "seconds_a_box": list(a_box(rows)),
        "faster": list(faster(rows, first)),
        "seconds": _spread(totals),
        "parts": {part: _spread([row["seconds"][part] for row in rows]) for part in rows[0]["seconds"]},
        "force_n": _spread(forces) | {"largest": max(forces)},
        "force_95_n": list(upper(forces)),
        "harder_n": list(mean(harder)),
        "unseen_mm": max(row["unseen_mm"] for row in rows),
        "unseen_too_far": sum(row["unseen_mm"] > row["unseen_allowed_mm"] + 1e-6 for row in rows),
        "frames_s": _spread(frames) if frames else None,
    }


def _spread(values: Sequence[float] | NDArray[np.float64]) -> dict[str, float]:
    return {
        "mean": float(np.mean(values)),
        "median": float(np.median(values)),
        "95": float(np.quantile(values, 0.95)),
    }


def front(points: Sequence[Row]) -> set[str]:
    """Names of the points that no other beats in seconds a box, in force or in boxes without losing in another.

    Only what any cell can run counts: a choice that needs more of a cell is neither on the front nor beats another.
    """
    points = [point for point in points if not point["needs"]]

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
    names = [n for n in data["points"][0]["parts"] if any(p["parts"][n]["mean"] >= 0.005 for p in data["points"])]
    return table(
        data["points"],
        ("settings", "name"),
        *((name, lambda p, name=name: p["parts"][name]["mean"], ".2f") for name in names),
        ("touch to last frame", lambda p: p["frames_s"] and p["frames_s"]["mean"], ".2f"),
    )


def pace_page(data: Row) -> str:
    """The whole of docs/pace.md from pace.json."""
    of = {point["name"]: point for point in data["points"]}
    return page(
        f"""
        # What accuracy costs, in seconds a box

        Written by `make pace`, played at commit `{data["commit"][:12]}`. Everything is simulated: {data["insertions"]}
        insertions a choice in drawn worlds with drawn objects (seed {data["seed"]}, bristle tier; no choice was made on
        them), in lock step, through the service's session and the client's own state machine, ramps and leases. A box
        begins 30 mm above the approach and ends when the insertion is confirmed or given up. *Seconds a box* are all
        seconds over all boxes inserted, so a failure costs what it took. All choices begin from the same starts;
        intervals are of 95 % (bootstrap over starts, Wilson's for shares). **Bold**: of the choices that any cell can
        run, none is better in one of seconds, force, boxes and false claims and as good in the rest.
        """,
        _untrue(data["points"]),
        data.get("note", ""),
        f"![force, success, direction and physics, each against what it costs in time]({NAME}.png)",
        _figures(data["kept"]),
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
        _early(data["kept"], of[SHIPPED]),
        BESIDES,
    )


def _untrue(points: Sequence[Row]) -> str:
    """Each claim that was not true, and why; nothing where all were."""
    each = [
        f"Start {start}, {point['name'].split(':')[0]}: {'; '.join(why)}."
        for point in points
        for start, *why in point["untrue"]
    ]
    return f"**Claims that were not true: {len(each)}.** {' '.join(sorted(each))}" if each else ""


def _figures(kept: Row) -> str:
    """What the figures show, and what is left out of them."""
    slip, builds = kept["slip"], {row["name"]: row for row in kept["builds"]}
    images, true = slip["images"], slip["true fields"]
    return f"""
    A star is what ships; bars are intervals of 95 %. (a) The paper states no speed and no time a box, so its pace has
    no mark. (b) and (c): held-out simulated decisions of the [depths](depths.md) and of each model's card; [what a
    decision costs](benchmark.md). {kept["press_mm"]:g} mm of pressing ships, between two marks of (b). Networks of one
    colour were asked about the same collisions, those of the other about others. No build in int8 pays: the two that
    command what fp32 does take {builds["int8 dynamic"]["cpu_ms"]:.1f} and {builds["int8 blocked"]["cpu_ms"]:.1f} ms
    instead of {builds["fp32"]["cpu_ms"]:.1f}, for networks that no cell needs. (d) One descent against the
    [finest elements](foreign_check.md), without intervals, for it is computed and not drawn.

    Slip has no figure, because there is nothing to choose: one tracker ships, {slip["ms"]:.1f} ms a frame of a finger.
    From pictures it is right in {Estimate(*images["accuracy"]):.1%}, from true fields in
    {Estimate(*true["accuracy"]):.1%}, both with a median delay of {images["delay_frames"]["median"]:.0f} frame and no
    false alarm ([slip report](slip_report.md)).

    The same figures to hover and zoom in, with every interval: `pip install plotly`, then `python -m simulation pace
    --draw --docs docs --html runs/pace.html` writes one file of 5 MB that needs no network.
    """


def _share(right: Sequence[float]) -> str:
    return number(right[0], ".1%")


def _early(kept: Row, shipped: Row) -> str:
    """What deciding earlier saves."""
    least, reads_mm, press_mm = kept["sure"][EARLY[0]], kept["reads_mm"], kept["press_mm"]
    waits_s, attempts = shipped["frames_s"]["mean"], shipped["attempts"]
    share = attempts * waits_s / shipped["seconds"]["mean"]
    return f"""
    **Early decisions.** Nothing is waited for after standstill: the networks have read what they need before the arm
    stands. From the touch to the last frame that a decision reads pass {waits_s:.2f} s, {number(share, ".0%")} of all
    seconds with {attempts:.1f} attempts. An attempt presses by {press_mm:g} mm instead of the {reads_mm:g} that the
    networks can read, {number(1.0 - press_mm / reads_mm, ".0%")} less, at no loss of success or trials, and with fewer
    trips to the fixture ([the depth of a decision](decisions/0079-the-depth-of-a-decision.md)). Stopping as soon as a
    direction has the probability 0.6 would save {number(least["saved"], ".0%")} of {reads_mm:g} mm, and
    {_share(least["right"])} of held-out directions would be right instead of
    {_share(kept["depths"][f"test, {reads_mm:.1f} mm"])}. That saves no more, so it was not built.
    """


def _choices(of: Row) -> str:
    """What ships and why, with the figures that it rests on."""
    before, shipped, quick = of[BEFORE], of[SHIPPED], next(point for point in of.values() if point["needs"])
    times, afresh = Estimate(*shipped["faster"]), shipped["parts"]["take afresh"]["mean"]
    wanted = f"{WANTED:g} times fewer seconds were wanted. " if times.value < WANTED else ""
    return f"""
    ## What ships, and why

    **Shipped settings need {times:.2f} times fewer seconds a box than those before**, and touch more gently: the
    largest force of an insertion is {-shipped["harder_n"][0]:.1f} N lower in the mean. Half of the boxes take no more
    than {shipped["seconds"]["median"]:.1f} s instead of {before["seconds"]["median"]:.1f}, the slowest 5 % more than
    {shipped["seconds"]["95"]:.1f} instead of {before["seconds"]["95"]:.1f}: boxes that are taken afresh several times
    carry the mean. {wanted}Trips to the fixture take {number(afresh / shipped["seconds"]["mean"], ".0%")} of all
    seconds, and two thirds of a trip are 300 mm there and back at 80 mm/s.

    **Probing speed**: {shipped["client"]["ramps"]["descend"]["speed_mm_s"]:g} mm/s around the blocks' tops,
    {shipped["client"]["pace"]["fast_mm_s"]:g} mm/s above and below. Slower is quicker here: what turns a part in the
    hand is the way that the arm goes on after its contact, and a trip to the fixture costs more than all that a
    quicker touch saves. There are {shipped["trips"]:.2f} trips a box instead of {before["trips"]:.2f}. The legs outside
    the band are no faster than the whole descent was before, on the same lease of 1.5 mm. Arms that have one speed, and
    cells whose cameras do not bear the legs, probe all the way. **Pressing**: 0.75 mm after the touch instead of 1.2,
    for the last of it turns the part most.

    **Travel**: 80 mm/s, which the limits have always allowed; a turn keeps to 55 deg/s. **Lift**: 3 mm above the
    highest height at which an attempt was stopped, for no part that is upright to 2 deg reaches lower than that.

    **Not shipped**: the quick choice. It needs {quick["needs"]}, and a PC that judges every frame. Harder ramps
    were never distinguished from the slow ones on a live cell. `choose` writes the settings that keep what you ask
    for, or the nearest where none does, as none with a false claim; with `--world` it plays all choices in your cell
    first:

    <!-- not executed: writes pace.toml -->
    ```sh
    python -m simulation choose --seconds-a-box 15 --success 0.95 --max-force 40
    ```
    """


def write(data: Row, docs: Path, html: Path | None = None) -> str:
    """Write NAME.md, .json and .png into the folder, and ``html`` if named; returns the text."""
    docs.mkdir(parents=True, exist_ok=True)
    shown = figures(data, front(data["points"]))
    draw(shown, docs / f"{NAME}.png")
    if html:
        write_html(shown, html)
    return publish(docs, NAME, pace_page(data), data)
