"""Page and figure of `simulation.studies.accuracy`."""

from pathlib import Path
from typing import Any

from reporting.figure import BLUE, GREEN, GREY, RED, drawing, label
from reporting.page import page
from reporting.table import table
from service.contract import Sensor

Row = dict[str, Any]
DEFAULT, LAYER = "default: load step 0.17 mm, 20 x 21 nodes", "layer, load step 0.17 mm, 20 x 21 nodes"
FAMILIES = {"load step": ("o", BLUE), "nodes": ("s", GREEN), "effects": ("x", GREY), "layer": ("D", RED)}
ERRORS = (("position um", "position_um", ".2f"), ("turn deg", "turn_deg", ".4f"), ("force N", "force_n", ".3f"),
          ("markers um", "markers_um", ".2f"))  # fmt: skip


def accuracy_page(report: Row) -> str:
    times: dict[str, dict[str, float]] = report["probe_ms"]
    kinds, raw = next(iter(times.values())), Sensor.load().raw
    return page(
        """
        # What physics accuracy costs
        """,
        summary(report["costs"]),
        """
        ![marker error over CPU time](accuracy.png)

        ## How it was measured

        Each scene is probed once, with an error of 8 mm and 5 deg, to 1.5 mm past touchdown, where part of the contact
        slips. Errors are those at the end of the probe; that of the markers is the RMS over both fingers, in the
        displacement since the grasp. CPU time is the best of several runs on one core.

        The first four error columns compare with the converged solution of the same tier (bristle: 60 x 63 nodes per
        pad, load step 0.01 mm; layer: 40 x 42 nodes, 0.02 mm). The last four compare with the converged layer tier.
        """,
        table(
            report["costs"],
            ("scene", "scene"),
            ("setting", "setting"),
            ("CPU ms", "cpu_ms", ".2f"),
            *((title, f"numerical.{key}", spec) for title, key, spec in ERRORS),
            *((f"layer: {title}", f"model.{key}", spec) for title, key, spec in ERRORS),
        ),
        "## CPU ms of a complete probe",
        table(times.items(), ("scene", 0), *((kind, lambda row, kind=kind: row[1][kind], ".1f") for kind in kinds)),
        f"""
        The times are for one core. Images are camera frames of {raw.width_px} x {raw.height_px} px of both fingers,
        rendered and rectified.

        Made by `make accuracy`.
        """,
    )


def summary(rows: list[Row]) -> str:
    """The conclusion in a few sentences: the default of each tier, averaged over the scenes."""

    def mean(setting: str, kind: str, name: str) -> float:
        values = [row[kind][name] for row in rows if row["setting"] == setting]
        return float(sum(values) / len(values))

    own, limit = (mean(setting, "numerical", "markers_um") for setting in (DEFAULT, LAYER))
    markers, force, turn = (mean(DEFAULT, "model", name) for name in ("markers_um", "force_n", "turn_deg"))
    default_ms, layer_ms = (sum(row["cpu_ms"] for row in rows if row["setting"] == name) for name in (DEFAULT, LAYER))
    return (
        f"On average over {sum(row['setting'] == DEFAULT for row in rows)} scenes, the default bristle model differs "
        f"from the layer tier by {markers:.0f} um RMS of the markers, {force:.1f} N and {turn:.2f} deg. It solves its "
        f"own equations to {own:.1f} um, so finer steps and grids of bristles gain nothing. At the same steps and "
        f"grid, the layer tier is within {limit:.1f} um of its converged solution and costs "
        f"{layer_ms / default_ms:.0f} times as much."
    )


def draw(rows: list[Row], path: Path) -> None:
    """Marker error over CPU time, one panel a scene; above against the own tier, below against the layer tier."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    with drawing(path, 2, len(scenes), size=(3.6 * len(scenes), 8.0), sharex=True, sharey="row") as panels:
        for line, kind, reference in zip(panels, ("numerical", "model"), ("same", "layer"), strict=True):
            line[0].set_ylabel(f"markers against the {reference} tier, um RMS")
            for panel, scene in zip(line, scenes, strict=True):
                _panel(panel, [row for row in rows if row["scene"] == scene], kind)
                panel.set(xscale="log", yscale="log")
        for above, below, scene in zip(*panels, scenes, strict=True):
            above.set_title(scene)
            below.set_xlabel("CPU time of a poke, ms")
        panels[0, 0].legend()


def _panel(panel: Any, rows: list[Row], kind: str) -> None:
    for family, (marker, colour) in FAMILIES.items():
        members = [row for row in rows if row["family"] == family]
        points = [(row["cpu_ms"], max(row[kind]["markers_um"], 1e-2)) for row in members]
        line = "-" if family == "load step" else "none"
        panel.plot(*zip(*points, strict=True), marker=marker, color=colour, linestyle=line, alpha=0.8, label=family)
        for row, point in zip(members, points, strict=True):
            if row["setting"] in {DEFAULT, LAYER}:
                label(panel, point, "default", colour=colour)
