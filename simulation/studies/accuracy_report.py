"""Table and picture of `simulation.studies.accuracy`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

Row = dict[str, Any]
# family -> marker, colour, whether its points are one curve
STYLES = {
    "load step": ("o", "tab:blue", True),
    "nodes": ("s", "tab:green", False),
    "effects": ("x", "tab:gray", False),
    "layer": ("D", "tab:red", False),
}
HEAD = """# What physics accuracy costs

Poke: x 8 mm, yaw 5 deg, 1.5 mm past touchdown, friction partly slipping. Errors are those at its end; markers are the
RMS of their motion since the grasp over both fingers. The first errors are against the same tier, converged (bristle:
60 x 63 nodes a pad, load step 0.01 mm; layer: 40 x 42 nodes, 0.02 mm), the last four against the converged layer
tier: they hold what the bristles leave out. CPU time is the best of several runs on one core.

![marker error over CPU time](accuracy.png)

"""
COLUMNS = (
    "scene", "setting", "CPU ms", "position um", "turn deg", "force N", "markers um",
    "layer: position um", "turn deg", "force N", "markers um",
)  # fmt: skip


def _line(cells: list[str] | tuple[str, ...]) -> str:
    return f"| {' | '.join(cells)} |"


def _errors(error: Row) -> list[str]:
    return [
        f"{error['position_um']:.2f}",
        f"{error['turn_deg']:.4f}",
        f"{error['force_n']:.3f}",
        f"{error['markers_um']:.2f}",
    ]


def _mean(rows: list[Row], setting: str, kind: str, name: str) -> float:
    found = [row[kind][name] for row in rows if row["setting"] == setting]
    return float(sum(found) / len(found))


def reading(rows: list[Row]) -> str:
    """What the table says, in a few sentences: the default of each tier, averaged over the scenes."""
    cheap, dear = "default: load step 0.17 mm, 20 x 21 nodes", "layer, load step 0.17 mm, 20 x 21 nodes"
    own, limit = (_mean(rows, setting, "numerical", "markers_um") for setting in (cheap, dear))
    markers, force, turn = (_mean(rows, cheap, "model", name) for name in ("markers_um", "force_n", "turn_deg"))
    time = {name: sum(row["cpu_ms"] for row in rows if row["setting"] == name) for name in (cheap, dear)}
    return (
        f"The default computes its own model to {own:.1f} um RMS of the markers. The model itself is {markers:.0f} um, "
        f"{force:.1f} N and {turn:.2f} deg\nfrom the layer's, so finer steps and grids of bristles buy nothing. The "
        f"layer costs {time[dear] / time[cheap]:.0f} times as much and is within\n{limit:.1f} um of its own limit "
        "at the same steps and grid."
    )


IMAGES = (
    "One core. Images are camera frames of 427 x 320 px of both fingers, drawn and rectified. A frame whose gel\n"
    "has not moved since the one before, as most of a probe's, is lit once and only grained anew."
)


def as_markdown(rows: list[Row], times: dict[str, dict[str, float]]) -> str:
    """The whole of docs/accuracy.md."""
    lines = [_line(COLUMNS), "|---|---|" + "---:|" * (len(COLUMNS) - 2)]
    for row in rows:
        cells = [row["scene"], row["setting"], f"{row['cpu_ms']:.2f}"]
        lines.append(_line(cells + _errors(row["numerical"]) + _errors(row["model"])))
    kinds = list(next(iter(times.values())))
    probes = [_line(["scene", *kinds]), "|---|" + "---:|" * len(kinds)]
    probes += [_line([scene, *(f"{found[kind]:.1f}" for kind in kinds)]) for scene, found in times.items()]
    table, costs = "\n".join(lines), "\n".join(probes)
    whole = f"## A whole probe, CPU ms\n\n{costs}\n\n{IMAGES}"
    return f"{HEAD}{reading(rows)}\n\n{table}\n\n{whole}\n\nMade by `make accuracy`.\n"


def draw(rows: list[Row], path: Path) -> None:
    """Marker error over CPU time, one panel a scene; above against the own tier, below against the layer."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    figure = Figure(figsize=(3.6 * len(scenes), 8.0), dpi=90, layout="constrained")
    panels = figure.subplots(2, len(scenes), sharex=True, sharey="row", squeeze=False)
    for top, kind in enumerate(("numerical", "model")):
        for panel, scene in zip(panels[top], scenes, strict=True):
            _panel(panel, [row for row in rows if row["scene"] == scene], kind)
            panel.xaxis.set_major_locator(LogLocator(10))
            panel.xaxis.set_minor_formatter(NullFormatter())
            panel.yaxis.set_minor_formatter(NullFormatter())
            panel.set_title(scene if top == 0 else "")
            panel.set_xlabel("CPU time of a poke, ms" if top else "")
            panel.grid(alpha=0.3)
    panels[0, 0].set_ylabel("markers against the same tier, um RMS")
    panels[1, 0].set_ylabel("markers against the layer tier, um RMS")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8)
    FigureCanvasAgg(figure).print_png(str(path))


def _panel(panel: Any, rows: list[Row], kind: str) -> None:
    panel.set_xscale("log")
    panel.set_yscale("log")
    for family, (marker, colour, joined) in STYLES.items():
        mine = [row for row in rows if row["family"] == family]
        points = [(row["cpu_ms"], max(row[kind]["markers_um"], 1e-2)) for row in mine]
        if joined:
            panel.plot(*zip(*points, strict=True), "-", color=colour, alpha=0.4)
        for index, (row, point) in enumerate(zip(mine, points, strict=True)):
            fade = 1.0 - 0.7 * index / max(1, len(mine))
            panel.plot(*point, marker, color=colour, alpha=fade, label=row["setting"], linestyle="none")
