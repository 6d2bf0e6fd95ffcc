"""The trade-off as one page and one figure set: quality against log time, the Pareto front marked."""

from pathlib import Path
from typing import Any

from export.measure import NOISY
from export.points import Point, Table, pareto

NAME = "tradeoff"
TITLES = {
    "networks": "networks: right direction, share",
    "slip": "slip trackers: right verdicts, share",
    "physics": "physics: marker error against the reference, um",
}
COSTS = {
    "networks": "CPU ms of a whole decision, one thread",
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
        "Written by `make tradeoff`. Every point is a trained network, a tracker or a solver setting that was really",
        "run. Accuracy and time of networks are measured on rendered frames of the simulator, not of a real gel:",
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
    lines += _agreements(about)
    lines += [
        "## Slip trackers",
        "",
        "| tracker | right verdicts | misses | false | CPU ms a frame |",
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
    """Which input sizes were trained: a size without a trained network does not appear."""
    sizes = sorted({tuple(point.about["input_px"]) for point in points})
    shown = ", ".join(f"{height} x {width}" for height, width in sizes)
    return [f"Input sizes with a trained network: {shown} px (pooled or resized inside the graph)."]


def _agreements(about: dict[str, Any]) -> list[str]:
    """int8 and fp16 judged by the commands they would change."""
    return [
        "## Do smaller weights change commands?",
        "",
        "Each twin against its fp32 source after 8 frames, by the command of the paper's rule. `int8` holds the layers",
        "that may be int8 without that, `int8 whole` all of them.",
        "",
        *(f"- {row['name']}: {row['verdict']}" for row in about["agreement"]),
        "",
    ]


def _default(points: list[Point]) -> str:
    chosen = default_network(points)
    best = max(points, key=lambda point: point.better)
    return (
        f"The cheapest that cannot be told from the best ({best.name}) is **{chosen.name}**: its interval still holds"
        f" the best accuracy. The default is the fp32 pair with 8 frames because the controllers' uncertainty was"
        f" calibrated on 8 frames, and at {_default_cost(points)} a step time does not bind."
    )


def _default_cost(points: list[Point]) -> str:
    steps = [p.about["step_cpu_ms"] for p in points if p.about["precision"] == "fp32" and p.about["folder"] == "models"]
    return f"{steps[0]:.1f} ms CPU" if steps else "its cost"


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

    figure, panels = plt.subplots(1, 3, figsize=(18, 6), layout="constrained")
    for (section, points), axes in zip(table.items(), panels, strict=True):
        _panel(axes, points, section, -1 if section == "physics" else 1)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def _panel(axes: Any, points: list[Point], section: str, sign: int) -> None:
    cost = [point.cost_ms for point in points]
    better = [sign * point.better for point in points]
    spread = [[abs(p.better - p.low) for p in points], [abs(p.high - p.better) for p in points]]
    axes.errorbar(
        cost, better, spread if sign > 0 else spread[::-1], fmt="o", color="steelblue", ecolor="lightsteelblue"
    )
    front = pareto(points)
    axes.step(
        [p.cost_ms for p in front],
        [sign * p.better for p in front],
        where="post",
        color="firebrick",
        label="Pareto front",
    )
    for point in front:
        axes.annotate(
            point.name, (point.cost_ms, sign * point.better), fontsize=7, xytext=(3, 3), textcoords="offset points"
        )
    axes.set(xscale="log", xlabel=COSTS[section], title=TITLES[section])
    if sign < 0:
        axes.invert_yaxis()
    axes.grid(visible=True, which="both", alpha=0.2)
    axes.legend(loc="lower right")
