"""The trade-off as one page and one figure set: quality against log time, the Pareto front marked."""

import re
from pathlib import Path
from typing import Any

from export.bench.measure import NOISY
from export.tradeoff.points import Point, Table, pareto

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
    """The default: the cheapest point whose interval still reaches the best accuracy found."""
    best = max(points, key=lambda point: point.better)
    return min((point for point in points if point.high >= best.better), key=lambda point: point.cost_ms)


def write(table: Table, about: dict[str, Any], path: Path) -> None:
    """Write the page."""
    lines = [
        "# What accuracy costs in time",
        "",
        "Written by `make tradeoff`. Every point is a trained network, a tracker or a solver setting that really ran.",
        f"Measured at commit `{about['commit'][:12]}`. Accuracy and time of networks are those on rendered frames of",
        "the simulator, not of a real gel:",
        f"{about['decisions']} collisions of the split `{about['split']}` of data `{about['data']}`,",
        f"on {about['cpu']}, one thread; 95 % intervals (Wilson's for shares). Quote processor time: wall times were",
        f"{about['crowding']:.2f} times it{' (noisy machine)' if about['crowding'] > NOISY else ''}.",
        "",
        f"![Quality against time]({NAME}.png)",
        "",
        "## Networks",
        "",
        "Fewer frames is the same network stopped early. `step` is what remains after the last frame; the camera's",
        "wait (33 ms a frame at 30 fps) comes on top and is shorter with fewer frames. `pair`: two networks;",
        "`shared`: both in one graph behind one backbone; `joint`: one density over (x, yaw). Mean trials: closed loop",
        "on the four training objects. **Bold**: on the Pareto front.",
        "",
        "| network | right direction | MAE mm, deg | mean trials | step p50 / p99 ms | its CPU | decision CPU | MB |",
        "|---|---|---|---|---|---|---|---|",
    ]
    front = {id(point) for point in pareto(table["networks"])}
    lines += [_network_row(point, id(point) in front) for point in sorted(table["networks"], key=lambda p: p.cost_ms)]
    lines += ["", _default(table["networks"]), "", *_sizes(table["networks"]), ""]
    lines += _agreements(about, table["networks"])
    lines += [
        "## Slip trackers",
        "",
        "| tracker | right decisions | misses | false | CPU ms a frame |",
        "|---|---|---|---|---|",
    ]
    front = {id(point) for point in pareto(table["slip"])}
    lines += [_slip_row(point, id(point) in front) for point in sorted(table["slip"], key=lambda p: p.cost_ms)]
    lines += ["", "Measured by `make slip-report`; the [slip report](slip_report.md) says what each one is.", ""]
    lines += ["## Physics", "", "| setting | marker error um (worst scene) | CPU ms a poke |", "|---|---|---|"]
    front = {id(point) for point in pareto(table["physics"])}
    lines += [_physics_row(point, id(point) in front) for point in sorted(table["physics"], key=lambda p: p.cost_ms)]
    lines += ["", "Measured by `make accuracy` against the finest layer tier; see [accuracy](accuracy.md).", ""]
    path.write_text("\n".join(lines))


def _bold(text: str, front: bool) -> str:
    return f"**{text}**" if front else text


def _share(point: Point) -> str:
    return f"{100 * point.better:.1f} % [{100 * point.low:.1f}, {100 * point.high:.1f}]"


def _network_row(point: Point, front: bool) -> str:
    trials = "not run" if point.mean_trials is None else "{:.2f} [{:.2f}, {:.2f}]".format(*point.mean_trials)
    about = point.about
    off = f"{about['mae_mm'][0]:.2f}, {about['mae_deg'][0]:.2f}"
    step = f"{about['step_p50_ms']:.2f} / {about['step_p99_ms']:.2f} | {about['step_cpu_ms']:.2f}"
    cells = (
        _bold(point.name, front),
        _share(point),
        off,
        trials,
        step,
        f"{point.cost_ms:.1f}",
        f"{about['size_mb']:.2f}",
    )
    return f"| {' | '.join(cells)} |"


def _sizes(points: list[Point]) -> list[str]:
    """What the networks read: an input size without a trained network does not appear."""
    readers: dict[str, set[str]] = {}
    for point in points:
        readers.setdefault(point.about["input"], set()).add(point.about["network"])
    shown = "; ".join(f"{size} a finger: {', '.join(sorted(names))}" for size, names in sorted(readers.items()))
    return [
        f"Input sizes with a trained network: {shown}. Pictures are pooled or resized inside the graph; markers are",
        "tracked for slip anyway, at the cost a frame that the slip trackers below have.",
    ]


def _agreements(about: dict[str, Any], points: list[Point]) -> list[str]:
    """int8 and fp16 by the commands they would change, and by what they gain."""
    refused = [f"- {line}" for line in about.get("refused", [])]
    return [
        "## Do smaller weights change commands?",
        "",
        "Each build against its fp32 source after 8 frames, by the command of the paper's rule, on collisions that",
        "calibrated no build. ONNX Runtime's quantiser makes them: `int8 static` takes its scales from calibration,",
        "`int8 dynamic` from every call, `int8 blocked` stores the weights of fully connected and recurrent layers in",
        "blocks of 16 (MatMulNBits). `fp16`: every weight in 16 bits, widened on loading.",
        "",
        *(f"- {row['name']}: {row['summary']}" for row in about["agreement"]),
        "",
        *gains(about["agreement"], points),
        "",
        *(
            []
            if any("int8" in row["name"] for row in about["agreement"])
            else ["No int8 build was measured in this run.", ""]
        ),
        *(["Refused, because the outputs are far off:", "", *refused, ""] if refused else []),
    ]


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
        f"The cheapest that cannot be told from the best ({best.name}) is **{chosen.name}**: its interval still holds"
        f" the best accuracy. The default is the fp32 pair with 8 frames because the controllers' uncertainty was"
        f" calibrated on 8 frames, and at {cost} a step time does not bind."
    )


def _slip_row(point: Point, front: bool) -> str:
    about = point.about
    misses, false = 100 * about["misses"], 100 * about["false"]
    return f"| {_bold(point.name, front)} | {_share(point)} | {misses:.1f} % | {false:.1f} % | {point.cost_ms:.2f} |"


def _physics_row(point: Point, front: bool) -> str:
    return f"| {_bold(point.name, front)} | {-point.better:.1f} ({-point.low:.1f}) | {point.cost_ms:.2f} |"


def draw(table: Table, path: Path) -> None:
    """One panel a section: quality with its interval against log time, the Pareto front as a line."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, panels = plt.subplots(1, 3, figsize=(21, 7), layout="constrained", width_ratios=[1.5, 1, 1])
    for (section, points), axes in zip(table.items(), panels, strict=True):
        _panel(axes, points, section, -1 if section == "physics" else 1)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def _panel(axes: Any, points: list[Point], section: str, sign: int) -> None:
    groups: dict[str, list[Point]] = {}
    for point in points:
        about = point.about
        groups.setdefault(f"{about['network']} {about['kind']}" if "kind" in about else "", []).append(point)
    for colour, (name, members) in enumerate(groups.items()):
        _points(axes, members, sign, f"C{colour}", name)
    front = pareto(points)
    cost, better = [p.cost_ms for p in front], [sign * p.better for p in front]
    axes.step(cost, better, where="post", color="firebrick", linewidth=1, label="Pareto front")
    for number, point in enumerate(front):
        # Neighbours on the front lie close together: their names alternate above and below it.
        place = {"xytext": (4, 5 if number % 2 else -11), "textcoords": "offset points"}
        name = point.name.split(" ", 1)[1] if "kind" in point.about else point.name
        axes.annotate(name, (point.cost_ms, sign * point.better), fontsize=7, **place)
    axes.set(xscale="log", xlabel=COSTS[section], title=TITLES[section])
    if sign < 0:
        axes.invert_yaxis()
    axes.grid(visible=True, which="both", alpha=0.2)
    axes.legend(loc="lower right", fontsize=8)


def _points(axes: Any, points: list[Point], sign: int, colour: str, name: str) -> None:
    """Points of one kind: the interval upright, p50 to p99 of the processor time along, mean trials written beside."""
    cost, better = [p.cost_ms for p in points], [sign * p.better for p in points]
    spread = [[abs(p.better - p.low) for p in points], [abs(p.high - p.better) for p in points]]
    tail = [_tail_ms(point) for point in points]
    style = {"fmt": "o", "color": colour, "elinewidth": 0.8, "alpha": 0.8, "label": name or None}
    axes.errorbar(cost, better, spread if sign > 0 else spread[::-1], [[0.0] * len(tail), tail], **style)
    for point in points:
        if point.mean_trials is not None:
            label, place = f"{point.mean_trials[0]:.2f} trials", (point.cost_ms, sign * point.better)
            axes.annotate(label, place, fontsize=8, color=colour, xytext=(4, 8), textcoords="offset points")


def _tail_ms(point: Point) -> float:
    """How much longer than its p50 the decision's p99 is, in processor time; 0 where only one time was measured."""
    about = point.about
    if "step_cpu_p99_ms" not in about:
        return 0.0
    return float(max(0.0, about["frames"] * (about["step_cpu_p99_ms"] - about["step_cpu_ms"])))
