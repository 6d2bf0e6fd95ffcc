"""The page of seconds a box: each choice of settings against what ships, on the same starts."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reporting.page import page, publish
from reporting.statistics import Estimate, mean, number
from robot_client.insertion.seconds import PARTS
from simulation.closed_loop.statistics import Row, claimed_wrongly
from simulation.studies.lateness import errors_ms
from simulation.studies.pace.figures import EARLY, figures
from simulation.studies.pace.front import beaten_by, front
from simulation.studies.pace.groups import groups
from simulation.studies.pace.panels import draw
from simulation.studies.pace.points import BEFORE, SHIPPED, Point
from simulation.studies.pace.resampled import a_box, faster, total_s, upper
from simulation.studies.pace.tables import by_group, columns, parts

NAME = "pace"
WANTED = 1.8  # times fewer seconds a box than before
BESIDES = """
## Beside a live insertion

Lock step plays the lateness of camera and arm, but [not the time of
perception](decisions/0018-closed-loop-in-lock-step.md#what-true-fields-leave-out). The rectangle, inserted live in the
simulated cell,
on two cores with seven busy programs:

| settings | cameras | inserted | pauses of the lease | one start (4.8 mm, 4.4 deg) |
| --- | --- | --- | --- | --- |
| as shipped | 30 frames a second | two of two | 0 | 8.6 s, three attempts |
| quick | 60 frames a second | three of three | 17 to 41 | 5.0 s, two attempts |

The arm's statistics count `pauses`. If a cell shows more than a few, leave its fast legs out. `python -m simulation run
--client pace.toml` plays a choice live. The client prints the parts of the time after every insertion.
"""


def report_of(rows: Sequence[Row], points: Sequence[Point]) -> Row:
    """What the page and its figure are written from, as plain data; every point has the same starts."""
    by_name = {point.name: [row for row in rows if row["condition"] == point.name] for point in points}
    first, beaten = by_name[points[0].name], beaten_by(points, by_name)
    return {
        "insertions": len(first),
        "points": [_point(point, by_name[point.name], first) | {"beaten_by": beaten[point.name]} for point in points],
        "groups": groups(by_name[SHIPPED]),
    }


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
        "claimed_wrongly": sum(map(claimed_wrongly, rows)),
        "untrue": [[row["index"], *row["shortfalls"]] for row in filter(claimed_wrongly, rows)],
        "attempts": float(np.mean([row["attempts"] for row in rows])),
        "trips": float(np.mean([row["grasps"] - 1 for row in rows])),
        "seconds_a_box": list(a_box(rows)),
        "faster": list(faster(rows, first)),
        "seconds": _spread(totals),
        "parts": {part: _spread([row["seconds"].get(part, 0.0) for row in rows]) for part in PARTS},
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


def pace_page(data: Row) -> str:
    """The whole of docs/pace.md from pace.json."""
    of = {point["name"]: point for point in data["points"]}
    return page(
        f"""
        # What accuracy costs, in seconds a box

        Written by `python -m simulation pace --seed {data["seed"]}`, played at commit `{data["commit"][:12]}`.
        Everything is simulated.

        **Result.** {_result(data, of)}
        """,
        _untrue(data["points"]),
        data.get("note", ""),
        f"![force, success, direction and physics, each against what it costs in time]({NAME}.png)",
        _figures(data["kept"]),
        f"""
        ## The choices

        {data["insertions"]} insertions a choice, all from the same starts in drawn worlds with drawn objects (seed
        {data["seed"]}, bristle tier), in lock step through the service's session and the client's state machine, ramps
        and leases. The shear reach was given. {_timed(data.get("late", ()))} A box begins 30 mm above the approach and
        ends when the insertion is confirmed or given up. *Seconds a box* are all seconds over all boxes inserted, so a
        failure costs the time that it took. *{BEFORE}*: 10 mm/s all the way, back up to the approach each time, presses
        by 1.2 mm, an upright tool, travel at 55 mm/s. Intervals are of 95 % (bootstrap over starts; Wilson for shares).

        **Bold**: no choice that any cell can run beats it, better by more than chance in seconds, force, boxes or false
        claims without being worse in another.
        """,
        columns(data, front(data["points"])),
        f"""
        *Times faster*, *gained, lost* (boxes) and *harder* (mean difference of the largest force, N) compare with
        *{BEFORE}*, start by start. *Regrasps*: how often a part that may have [turned in the
        hand](decisions/0112-an-object-that-has-turned-is-taken-afresh.md) was put back and grasped again, 300 mm away.
        *Unseen*: the furthest that the arm went down between the captures of two judged frames;
        {_within_the_lease(data)}

        Where the time goes, mean seconds. In lock step the service answers at once: waiting for frames, deciding and
        confirming take none.
        """,
        parts(data),
        "What ships, by object and by world; the quantities are cut into thirds:",
        by_group(data),
        _choices(of),
        _early(data["kept"], of[SHIPPED]),
        BESIDES,
    )


def _result(data: Row, of: Row) -> str:
    before, shipped = of[BEFORE], of[SHIPPED]
    times, false_n = Estimate(*shipped["faster"]), sum(point["claimed_wrongly"] for point in data["points"])
    claims_n = false_n + sum(point["inserted"] for point in data["points"])
    wanted = f" {WANTED:g} times were wanted." if times.value < WANTED else ""
    return f"""What ships takes {shipped["seconds_a_box"][0]:.1f} s a box instead of
        {before["seconds_a_box"][0]:.1f} before, {times:.2f} times fewer, and touches {-shipped["harder_n"][0]:.1f} N
        more gently in the mean.{wanted} {false_n} of {claims_n:,} claims were false. Half of the boxes take no more
        than {shipped["seconds"]["median"]:.1f} s, the slowest 5 % more than {shipped["seconds"]["95"]:.1f} s."""


def _timed(late: Sequence[Row]) -> str:
    if not late:
        return ""
    off_ms = errors_ms(late)
    return f"""Each cell was [timed first](decisions/0194-how-late-pictures-and-arm-are.md), and the client keeps to the
        bound on its lateness, {np.mean(off_ms):+.0f} ms from the truth on average. The {len(late) - len(off_ms)} of
        {len(late)} cells where that gave none were not played."""


def _within_the_lease(data: Row) -> str:
    beyond = ", ".join(
        f"{point['unseen_too_far']} of {data['insertions']} insertions of *{point['name'].split(':')[0]}*"
        f" ({point['unseen_mm']:.2f} mm)"
        for point in data["points"]
        if point["unseen_too_far"]
    )
    if not beyond:
        return "no choice went beyond its lease."
    return f"**beyond the lease in {beyond}.**"


def _untrue(points: Sequence[Row]) -> str:
    """Each false claim, and why; nothing where there is none."""
    each = [
        f"Start {start}, {point['name'].split(':')[0]}: {'; '.join(why)}."
        for point in points
        for start, *why in point["untrue"]
    ]
    return f"**False claims: {len(each)}.** {' '.join(sorted(each))}" if each else ""


def _figures(kept: Row) -> str:
    """What the figures show, and what is left out of them."""
    slip, builds_ms = kept["slip"], {row["name"]: row["cpu_ms"] for row in kept["builds"]}
    images, true, fp32_ms = slip["images"], slip["true fields"], builds_ms.pop("fp32")
    int8 = f"takes {min(builds_ms.values()):.1f} ms instead of {fp32_ms:.1f}" if builds_ms else "does not start here"
    return f"""
    A star is what ships; bars are intervals of 95 %.

    - (b), (c) Held-out simulated decisions, from the [depths](depths.md) and the model cards; CPU time from [what a
      decision costs](benchmark.md). {kept["press_mm"]:g} mm of pressing ships, between two marks of (b). Networks of
      one colour were asked about the same collisions, those of the other colour about others.
    - (c) No int8 build ships: the quickest {int8}.
    - (d) Networks that were trained in one tier of the gel each, tested in finite elements that none of them had seen:
      [more presses pay, finer physics does not](transfer.md).
    - One tracker of slip ships, {slip["ms"]:.1f} ms a finger and frame. It is right in
      {Estimate(*images["accuracy"]):.1%} from pictures and in {Estimate(*true["accuracy"]):.1%} from true fields, with
      a median delay of {images["delay_frames"]["median"]:.0f} frame and no false alarm ([slip
      report](slip_report.md)).
    """


def _share(right: Sequence[float]) -> str:
    return number(right[0], ".1%")


def _early(kept: Row, shipped: Row) -> str:
    """What deciding earlier saves."""
    least, reads_mm, press_mm = kept["sure"][EARLY[0]], kept["reads_mm"], kept["press_mm"]
    waits_s, attempts = shipped["frames_s"]["mean"], shipped["attempts"]
    share = attempts * waits_s / shipped["seconds"]["mean"]
    return f"""
    **Early decisions** would save little. From the touch to the last frame that a decision reads, {waits_s:.2f} s pass;
    with {attempts:.1f} attempts a box, that is {number(share, ".0%")} of all seconds. Pressing by {press_mm:g} mm saves
    {number(1.0 - press_mm / reads_mm, ".0%")} of the {reads_mm:g} mm that the networks can read ([the depth of a
    decision](decisions/0079-the-depth-of-a-decision.md)). To stop as soon as a direction has a probability of 0.6 would
    save {number(least["saved"], ".0%")}, with {_share(least["right"])} of held-out directions right instead of
    {_share(kept["depths"][f"test, {reads_mm:.1f} mm"])}.
    """


def _choices(of: Row) -> str:
    """What ships and why, with the figures that it rests on."""
    before, shipped, quick = of[BEFORE], of[SHIPPED], next(point for point in of.values() if point["needs"])
    regrasps = shipped["parts"]["regrasp"]["mean"] / shipped["seconds"]["mean"]
    return f"""
    ## What ships, and why

    Regrasps take {number(regrasps, ".0%")} of all seconds; half of one is the way of 300 mm to the fixture and
    back at 80 mm/s. What ships avoids them: {shipped["trips"]:.2f} a box instead of {before["trips"]:.2f}.

    - **Probing speed: {shipped["client"]["ramps"]["descend"]["speed_mm_s"]:g} mm/s around the tops of the blocks,
      {shipped["client"]["pace"]["fast_mm_s"]:g} mm/s above and below.** [Slower is
      quicker](decisions/0154-slow-around-the-tops.md): the way that the arm goes on after the contact turns the part in
      the hand, and a regrasp costs more than a quicker touch saves (*{_short(of, "one speed")}*). Arms with one speed
      probe all the way; late or slow cameras and late arms slow the legs down.
    - **Pressing: {shipped["client"]["pace"]["press_mm"]:g} mm after the touch instead of 1.2.** The last of the press
      turns the part most (*{_short(of, "deep")}*).
    - **Straightening: a tool tilted by up to 1.5 deg holds a turned part upright.** Only what turns further, or
      unseen, is regrasped (*{_short(of, "upright")}*).
    - **Lift: 3 mm above the highest height at which an attempt was stopped.** A part that is upright to 2 deg reaches
      no lower (*{_short(of, "high")}*).
    - **Travel: 80 mm/s;** a turn keeps to 55 deg/s.
    - **The belief decides,** with the networks for direction and magnitude in one file
      (*{_short(of, "heuristic")}*; *{_short(of, "joint")}*).
    - **Not shipped: the quick choice.** It needs {quick["needs"]}, and a PC that judges every frame.

    `choose` writes the settings that keep what you ask for, by their 95 % intervals, or the nearest if none does. It
    never prefers a choice with a false claim. With `--world` it plays all choices in your cell first, with the objects
    that `--objects` names:

    <!-- not executed: writes pace.toml -->
    ```sh
    python -m simulation choose --seconds-a-box 20 --success 0.95 --max-force 40
    ```
    """


def _short(of: Row, begin: str) -> str:
    """A choice by its short name, with how it compares."""
    point, shipped = next(of[name] for name in of if name.startswith(begin)), of[SHIPPED]
    seconds = f"{begin}: {point['seconds_a_box'][0]:.1f} s a box instead of {shipped['seconds_a_box'][0]:.1f}"
    if SHIPPED in point["beaten_by"]:
        return f"{seconds}, beaten by what ships"
    return (
        f"{seconds}, beats what ships"
        if point["name"] in shipped["beaten_by"]
        else f"{seconds}, neither beats the other"
    )


def write(data: Row, docs: Path) -> str:
    """Write NAME.md, .json and .png into the folder; returns the text."""
    docs.mkdir(parents=True, exist_ok=True)
    draw(figures(data, front(data["points"])), docs / f"{NAME}.png")
    return publish(docs, NAME, pace_page(data), data)
