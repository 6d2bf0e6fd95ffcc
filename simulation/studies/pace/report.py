"""The page of seconds a box: each choice of settings against what ships, on the same starts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reporting.figure import BLUE, GREY, ORANGE, PALETTE, drawing, label
from reporting.page import page, publish
from reporting.statistics import Estimate, bootstrap, wilson
from reporting.table import Table, table
from simulation.closed_loop.statistics import Row, in_order, title_of
from simulation.studies.pace.points import TODAY, Point

NAME = "pace"
EIGHT = "as shipped, networks of eight frames"
DRAWS = 2000
MERGED = {"retract": "up, over", "correct": "up, over"} | dict.fromkeys(
    ("arm", "stop", "wait for frames", "decide", "confirm"), "look"
)

LIVE = """
## Beside a live insertion

One insertion of the rectangle from 8 mm and 6 deg, live on a machine with eight busy programs on two cores, and in
lock step. As shipped, four attempts each: guarded descent 5.1 s live and 5.0 s in lock step, retract 1.6 and
1.6, correct 1.3 and 1.3, stop 0.3 and 0.5, arm 0.6 and 0.1. *The same, joint density*, two attempts and three: fast
descent 1.4 and 0.9, guarded descent 1.0 and 1.0, retract 0.3 and 0.5, correct 0.3 and 0.6, arm 0.1 and 0.1; live,
the lease paused the fast legs 18 times, which is what a busy machine costs. Lock step counts no way of a frame
through camera, network and perception.

**A choice with fast legs needs a PC that judges every frame of 60 a second.** Of four live insertions on that busy
machine, where the simulated cell took the same two cores, one inserted; the lease paused the three others until
the client held them, unwatched or out of time. Nothing was claimed that was not true. `pauses` in the arm's
statistics counts: take the probing speed all the way where there are more than a few.

The client prints the same parts at the end of every insertion, and keeps
them in its log. `python -m simulation run --fps 60 --client pace.toml` plays a choice live.
"""


def report_of(rows: Sequence[Row], points: Sequence[Point]) -> Row:
    """What the page and its figures are written from, as plain data; every point has the same starts."""
    by_name = {point.name: [row for row in rows if row["condition"] == point.name] for point in points}
    first = by_name[TODAY]
    return {
        "insertions": len(first),
        "objects": [title_of(scene) for scene in in_order({row["scene"] for row in first})],
        "points": [_point(point, by_name[point.name], first) for point in points],
    }


def _point(point: Point, rows: Sequence[Row], first: Sequence[Row]) -> Row:
    totals, forces = np.array([total_s(row) for row in rows]), [row["course"]["force_n"] for row in rows]
    frames = [trial["frames_s"] for row in rows for trial in row["trials"] if trial["frames_s"] is not None]
    objects = {title_of(scene): totals[[row["scene"] == scene for row in rows]] for scene in {r["scene"] for r in rows}}
    return {
        "name": point.name,
        "client": point.client,
        "fps": point.fps,
        "controller": "joint" if point.folder == "joint" else point.controller,
        "inserted": sum(row["inserted"] for row in rows),
        "claimed_wrongly": sum(row["claimed"] and not row["inserted"] for row in rows),
        "attempts": float(np.mean([row["attempts"] for row in rows])),
        "seconds_a_box": list(_a_box(rows)),
        "faster": list(_faster(rows, first)),
        "seconds": _spread(totals),
        "parts": {part: _spread([row["seconds"][part] for row in rows]) for part in rows[0]["seconds"]},
        "objects": {name: _spread(mine) for name, mine in sorted(objects.items())},
        "force_n": _spread(forces) | {"largest": max(forces)},
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
        ("seconds a box", "seconds_a_box", ".2f"),
        ("times faster", "faster", ".2f"),
        ("median s", "seconds.median", ".2f"),
        ("95 % s", "seconds.95", ".2f"),
        ("inserted", lambda p: wilson(p["inserted"], count), ".0%"),
        ("false claims", "claimed_wrongly", "d"),
        ("attempts", "attempts", ".2f"),
        ("force 95 %, N", "force_n.95", ".1f"),
        ("largest N", "force_n.largest", ".1f"),
    )


def parts(data: Row) -> Table:
    """Where the seconds go: mean, with median and 95 % of the whole in the other table."""
    names = list(data["points"][0]["parts"])
    return table(
        data["points"],
        ("settings", "name"),
        *((name, lambda p, name=name: p["parts"][name]["mean"], ".2f") for name in names),
        ("touch to last frame", lambda p: p["frames_s"] and p["frames_s"]["mean"], ".2f"),
    )


def draw(data: Row, path: Path) -> None:
    """Seconds against force, where they go, and object by object."""
    best = front(data["points"])
    with drawing(path, 1, 3, size=(15, 5), width_ratios=(5, 5, 4)) as axes:
        _draw_front(axes[0, 0], data["points"], best)
        _draw_parts(axes[0, 1], data["points"])
        _draw_objects(axes[0, 2], data)


def _draw_front(panel: Any, points: Sequence[Row], best: set[str]) -> None:
    for number, point in enumerate(points):
        value, low, high = point["seconds_a_box"]
        colour = BLUE if point["name"] in best else GREY
        force = point["force_n"]["95"]
        panel.errorbar(value, force, xerr=[[value - low], [high - value]], fmt="o", color=colour, capsize=2)
        label(panel, (value, force), str(number + 1), colour=colour, dy=5.0)
    panel.set(xlim=(0, None), ylim=(0, None), xlabel="seconds a box", ylabel="force, 95 % of insertions below, N")
    panel.set_title("cost against force; blue: on the front; numbers: see beside")


def _draw_parts(panel: Any, points: Sequence[Row]) -> None:
    names = list(dict.fromkeys(MERGED.get(name, name) for name in points[0]["parts"]))
    places, left = np.arange(len(points)), np.zeros(len(points))
    for name, colour in zip(names, PALETTE, strict=False):
        width = np.array(
            [sum(of["mean"] for part, of in p["parts"].items() if MERGED.get(part, part) == name) for p in points]
        )
        panel.barh(places, width, left=left, color=colour, height=0.7)
        row = int(np.flatnonzero(width > 0.0)[0])
        panel.text(left[row] + width[row] / 2, row or -0.55, name, ha="center", va="center", fontsize=7)
        left += width
    panel.set_yticks(places, [f"{number + 1} {point['name']}" for number, point in enumerate(points)], fontsize=7)
    panel.invert_yaxis()
    panel.set(xlabel="mean seconds of an insertion", title="where they go")


def _draw_objects(panel: Any, data: Row) -> None:
    first = data["points"][0]
    quickest = min(data["points"], key=lambda point: point["seconds_a_box"][0])
    for point, colour, off in ((first, GREY, -0.12), (quickest, ORANGE, 0.12)):
        for place, name in enumerate(data["objects"]):
            of = point["objects"][name]
            panel.plot([of["median"], of["95"]], [place + off] * 2, color=colour, lw=1.5)
            panel.plot(of["median"], place + off, "o", color=colour, ms=4)
    panel.set_yticks(range(len(data["objects"])), data["objects"], fontsize=7)
    panel.invert_yaxis()
    panel.set(xlim=(0, None), xlabel="seconds: median, line to 95 %", title="grey: as shipped; orange: quickest")


def pace_page(sets: dict[str, Row]) -> str:
    """The whole of docs/pace.md from pace.json: a section a set of worlds."""
    blocks: list[str | Table] = [
        """
        # What accuracy costs, in seconds a box

        Written by `make pace`. Everything is simulated: insertions in lock step, through the service's session and the
        client's own state machine, ramps and leases. A box begins 30 mm above the approach and ends when the insertion
        is confirmed or given up. *Seconds a box* are all seconds over all boxes inserted, so a failure costs what it
        took. All choices begin from the same starts; intervals are of 95 % (bootstrap over starts, Wilson's for
        shares). **Bold**: no other choice is better in one of seconds, force, boxes and false claims and as good in
        the rest.
        """,
        """
        It was made before objects that have turned in the hand were
        [taken afresh](decisions/0112-an-object-that-has-turned-is-taken-afresh.md), which takes some 13 s each
        time: all choices take longer now.
        """,
    ]
    for title, data in sets.items():
        blocks += [
            f"## {title[0].upper()}{title[1:]}",
            f"{data['insertions']} insertions a choice, {len(data['objects'])} objects.",
            columns(data, front(data["points"])),
            "Mean seconds by what was waited for:",
            parts(data),
        ]
    blocks.insert(4, f"![cost against force, where the seconds go, object by object]({NAME}.png)")
    return page(*blocks, _choices(next(iter(sets.values()))), LIVE)


def _choices(data: Row) -> str:
    """What ships and why, with the figures that it rests on."""
    of = {point["name"]: point for point in data["points"]}
    early = ""
    if EIGHT in of:
        saved = 1.0 - of[TODAY]["frames_s"]["mean"] / of[EIGHT]["frames_s"]["mean"]
        early = f"""
        **Frames a decision.** From the touch to the last frame that a decision reads, networks of eight frames take
        {of[EIGHT]["frames_s"]["mean"]:.2f} s, those that stop the arm when they have seen enough
        {of[TODAY]["frames_s"]["mean"]:.2f} s: {saved:.0%} less. After standstill nothing is waited for. Stopping after
        0.9 mm of pressing instead of 1.2 would save another 0.03 s an attempt and cost three points of direction
        ([decision 79](decisions/0079-the-depth-of-a-decision.md)), so it is not built.
        """
    return f"""
    ## What ships, and why

    The gentle end ships; what is on the front is a file away. **Ramps**: the slow ones. In lock step *brisk* costs
    nothing, but two of two live insertions of the rectangle with brisk ramps and the pair of networks ended with the
    part tilted by 2.1 and 2.7 deg, and were claimed; with the slow ones it was one of three. That is too few to
    tell them apart, and enough not to ship the quicker. **Probing speed**: 10 mm/s, because at 30 frames a second
    a faster stop is a later one, and pushes harder. **Approach**: 5 mm above the blocks; 3 mm are quicker,
    but how well the object's height is known is the cell's own matter.
    With `lift_mm = 3.0` an approach of 5 mm is as quick as one of 3.
    **Fast legs**: off, because they need cameras of 38 frames a second or more, and EGM. With cameras of 60, `choose`
    writes them; try them on your cell before you trust them:

    <!-- not executed: writes pace.toml -->
    ```sh
    python -m simulation choose --seconds-a-box 4.5 --success 0.95 --max-force 40
    ```

    {early}

    **What each bound is**: [why a descent may change its speed](decisions/0104-a-descent-at-two-speeds.md).
    """


def write(sets: dict[str, Row], docs: Path) -> str:
    """Write NAME.md, .json and .png into the folder; returns the text."""
    docs.mkdir(parents=True, exist_ok=True)
    draw(next(iter(sets.values())), docs / f"{NAME}.png")
    return publish(docs, NAME, pace_page(sets), sets)
