"""The trade-off as one page and one figure: quality against log time, the Pareto front marked."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from export.bench.measure import NOISY
from export.tradeoff.points import Point, Points, pareto, points_in
from reporting.figure import PALETTE, RED, drawing, label
from reporting.page import page
from reporting.statistics import Estimate
from reporting.table import Table, table

NAME = "tradeoff"
LEAST_KEPT = 0.99
"""Share of decisions whose command a build must keep."""
PAYS = 0.95
"""Share of fp32's time below which a build is faster."""
TITLES = {
    "networks": "networks: right direction, share",
    "slip": "slip trackers: right decisions, share",
    "physics": "physics: marker error against the reference, um",
}
COSTS = {
    "networks": "CPU ms of a whole decision, one thread: p50, whisker to p99",
    "slip": "CPU ms a frame of one finger",
    "physics": "CPU ms a poke",
}


def default_network(points: list[Point]) -> Point:
    """The default: the cheapest point whose interval still reaches the best accuracy measured."""
    best = max(points, key=lambda point: point.better)
    return min((point for point in points if point.high >= best.better), key=lambda point: point.cost_ms)


def tradeoff_page(about: dict[str, Any]) -> str:
    """The whole of docs/tradeoff.md from tradeoff.json."""
    points = points_in(about)
    return page(*_networks(about, points["networks"]), *_others(points["slip"], points["physics"]))


def _networks(about: dict[str, Any], networks: list[Point]) -> Iterator[str | Table]:
    yield f"""
        # What accuracy costs in time

        Written by `make tradeoff`. Every point is a trained network, a tracker or a solver setting that really ran.
        Measured at commit `{about["commit"][:12]}`. Accuracy and time of networks are those on rendered frames of the
        simulator, not of a real gel: {about["decisions"]} collisions of the split `{about["split"]}` of data
        `{about["data"]}`, on {about["cpu"]}, one thread. Intervals are of 95 % (Wilson's for shares). Quote processor
        time: wall times were {about["crowding"]:.2f} times it{" (noisy machine)" if about["crowding"] > NOISY else ""}.

        ![Quality against time]({NAME}.png)

        ## Networks

        Fewer frames is the same network stopped early. `step` is what remains after the last frame; the camera's wait
        (33 ms a frame at 30 fps) comes on top and is shorter with fewer frames. `pair`: two networks; `shared`: both in
        one graph behind one backbone; `joint`: one density over (x, yaw). Mean trials: closed loop on the four training
        objects. **Bold**: on the Pareto front.
        """
    yield _table(
        networks,
        ("network", "right direction"),
        ("MAE mm", "about.mae_mm.0", ".2f"),
        ("MAE deg", "about.mae_deg.0", ".2f"),
        ("mean trials", "mean_trials", ".2f"),
        ("step p50 ms", "about.step_p50_ms", ".2f"),
        ("p99 ms", "about.step_p99_ms", ".2f"),
        ("its CPU", "about.step_cpu_ms", ".2f"),
        ("decision CPU", "cost_ms", ".1f"),
        ("MB", "about.size_mb", ".2f"),
    )
    yield _default(networks)
    yield _sizes(networks)
    yield from _agreements(about, networks)


def _others(slip: list[Point], physics: list[Point]) -> Iterator[str | Table]:
    yield "## Slip trackers"
    yield _table(
        slip,
        ("tracker", "right decisions"),
        ("misses", "about.misses", ".1%"),
        ("false", "about.false", ".1%"),
        ("CPU ms a frame", "cost_ms", ".2f"),
    )
    yield """
        Measured by `make slip-report`; the [slip report](slip_report.md) says what each one is.

        ## Physics
        """
    yield table(
        _by_cost(physics),
        ("setting", 1),
        ("marker error um", lambda row: -row[0].better, ".1f"),
        ("worst scene", lambda row: -row[0].low, ".1f"),
        ("CPU ms a poke", "0.cost_ms", ".2f"),
    )
    yield "Measured by `make accuracy` against the finest layer tier; see [accuracy](accuracy.md)."


def _by_cost(points: list[Point]) -> list[tuple[Point, str]]:
    """Points and their names, bold on the front."""
    front = {id(point) for point in pareto(points)}
    ordered = sorted(points, key=lambda point: point.cost_ms)
    return [(point, f"**{point.name}**" if id(point) in front else point.name) for point in ordered]


def _table(points: list[Point], titles: tuple[str, str], *columns: tuple[str, str, str]) -> Table:
    return table(
        _by_cost(points),
        (titles[0], 1),
        (titles[1], lambda row: Estimate(row[0].better, row[0].low, row[0].high), ".1%"),
        *((title, f"0.{key}", spec) for title, key, spec in columns),
    )


def _sizes(points: list[Point]) -> str:
    """What the networks read: an input size without a trained network does not appear."""
    readers: dict[str, set[str]] = {}
    for point in points:
        readers.setdefault(point.about["input"], set()).add(point.about["network"])
    shown = "; ".join(f"{size} a finger: {', '.join(sorted(names))}" for size, names in sorted(readers.items()))
    return (
        f"Input sizes with a trained network: {shown}. Pictures are pooled or resized inside the graph; markers are "
        "tracked for slip anyway, at the cost a frame that the slip trackers below have."
    )


def _agreements(about: dict[str, Any], points: list[Point]) -> Iterator[str]:
    """int8 and fp16 by the commands they would change, and by what they gain."""
    yield """
        ## Do smaller weights change commands?

        Each build against its fp32 source after 8 frames, by the command of the paper's rule, on collisions that
        calibrated no build. ONNX Runtime's quantiser makes them: `int8 static` takes its scales from calibration, `int8
        dynamic` from every call, `int8 blocked` stores the weights of fully connected and recurrent layers in blocks of
        16 (MatMulNBits). `fp16`: every weight in 16 bits, widened on loading.
        """
    yield "\n".join(f"- {row['name']}: {row['summary']}" for row in about["agreement"])
    yield "\n".join(gains(about["agreement"], points))
    if not any("int8" in row["name"] for row in about["agreement"]):
        yield "No int8 build was measured in this run."
    if about.get("refused"):
        yield "Refused, because the outputs are far off:"
        yield "\n".join(f"- {line}" for line in about["refused"])


def gains(rows: list[dict[str, Any]], points: list[Point]) -> list[str]:
    """What each build saves, and whether it keeps the commands, in one sentence each."""
    whole = [point for point in points if point.about["frames"] == max(p.about["frames"] for p in points)]
    costs = {_build_name(point): (point.about["step_cpu_ms"], point.about["size_mb"]) for point in whole}
    lines = []
    for row in rows:
        source, precision = re.split(" (?=int8|fp16)", row["name"], maxsplit=1)
        exact, small = costs.get(f"{source} fp32"), costs.get(row["name"])
        if exact is None or small is None:
            continue
        gain = f"{small[0] / exact[0]:.2f} of fp32's time and {small[1] / exact[1]:.2f} of its size"
        saved = " and ".join(
            what for what, new, old in (("time", small[0], PAYS * exact[0]), ("space", small[1], exact[1])) if new < old
        )
        kept = row["same_command"] >= LEAST_KEPT
        lost = "" if kept else f", but keeps less than {100 * LEAST_KEPT:.0f} % of the commands: it does not pay"
        lines.append(f"- {source} {precision} takes {gain}: it saves {saved or 'nothing'}{lost}.")
    return lines


def _build_name(point: Point) -> str:
    return f"{point.about['network']} {point.about['kind']} {point.about['precision']}"


def _default(points: list[Point]) -> str:
    chosen = default_network(points)
    best = max(points, key=lambda point: point.better)
    steps = [p.about["step_cpu_ms"] for p in points if p.about["precision"] == "fp32" and p.about["folder"] == "models"]
    cost = f"{steps[0]:.1f} ms CPU" if steps else "its cost"
    return (
        f"The cheapest that cannot be told from the best ({best.name}) is **{chosen.name}**: its interval still holds "
        "the best accuracy. The default is the fp32 pair with 8 frames because the controllers' uncertainty was "
        f"calibrated on 8 frames, and at {cost} a step time does not bind."
    )


def draw(points: Points, path: Path) -> None:
    """One panel a section: quality with its interval against log time, the Pareto front as a line."""
    with drawing(path, 1, 3, size=(21, 7), dpi=80, width_ratios=[1.5, 1, 1]) as panels:
        for panel, (section, members) in zip(panels[0], points.items(), strict=True):
            _panel(panel, members, section, -1 if section == "physics" else 1)


def _panel(panel: Any, points: list[Point], section: str, sign: int) -> None:
    groups: dict[str, list[Point]] = {}
    for point in points:
        about = point.about
        groups.setdefault(f"{about['network']} {about['kind']}" if "kind" in about else "", []).append(point)
    for colour, (name, members) in zip(PALETTE, groups.items(), strict=False):
        _points(panel, members, sign, colour, name)
    front = pareto(points)
    cost, better = [p.cost_ms for p in front], [sign * p.better for p in front]
    panel.step(cost, better, where="post", color=RED, linewidth=1, label="Pareto front")
    for place, point in enumerate(front):
        # Neighbours on the front lie close together: their names alternate above and below it.
        name = point.name.split(" ", 1)[1] if "kind" in point.about else point.name
        label(panel, (point.cost_ms, sign * point.better), name, dy=5.0 if place % 2 else -11.0)
    panel.set(xscale="log", xlabel=COSTS[section], ylabel=TITLES[section])
    if sign < 0:
        panel.invert_yaxis()
    panel.legend(loc="lower right")


def _points(panel: Any, points: list[Point], sign: int, colour: str, name: str) -> None:
    """Points of one kind: the interval upright, p50 to p99 of the processor time along, mean trials written beside."""
    cost, better = [p.cost_ms for p in points], [sign * p.better for p in points]
    spread = [[abs(p.better - p.low) for p in points], [abs(p.high - p.better) for p in points]]
    tails = [[0.0] * len(points), [_tail_ms(point) for point in points]]
    style = {"fmt": "o", "color": colour, "elinewidth": 0.8, "alpha": 0.8, "label": name or None}
    panel.errorbar(cost, better, spread if sign > 0 else spread[::-1], tails, **style)
    for point in points:
        if point.mean_trials is not None:
            place = (point.cost_ms, sign * point.better)
            label(panel, place, f"{point.mean_trials[0]:.2f} trials", colour=colour, dy=8.0)


def _tail_ms(point: Point) -> float:
    """How much longer than its p50 the decision's p99 is, in processor time; 0 where only one time was measured."""
    about = point.about
    if "step_cpu_p99_ms" not in about:
        return 0.0
    return float(max(0.0, about["frames"] * (about["step_cpu_p99_ms"] - about["step_cpu_ms"])))
