"""docs/identify.md from identify.json: what probes tell of a gel, what is missed first."""

from collections.abc import Sequence

import numpy as np

from reporting.page import page
from reporting.statistics import Estimate, wilson
from reporting.table import Table, table
from simulation.closed_loop.statistics import Row
from simulation.studies.identify.posterior import PARAMETERS, WIDEST

ASKED = (0.85, 0.95)
NAMES = {
    "shear_modulus_n_per_mm2": "shear modulus",
    "friction": "friction",
    "thickness_mm": "thickness",
    "poisson_ratio": "Poisson's ratio",
    "margin_x_mm": "margin x",
    "margin_z_mm": "margin z",
    "relaxation_share": "share that relaxes",
    "relaxation_s": "time of relaxation",
    "shear_reach_mm": "shear reach",
}


def identify_page(data: Row) -> str:
    scored = [row for row in data["rows"] if "gel" in row]
    own = [row for row in scored if row["tier"] == "bristle"]
    other = [row for row in scored if row["tier"] != "bristle"]
    return page(
        "# What a cell's probes tell of its gel, simulated",
        _conclusion(own, other),
        data["note"],
        """
        `scene identify` reads the recordings of a commissioning: the four probes that ask for signs, and two presses
        until slip at each of two grips ([why so](decisions/0175-what-a-press-tells.md)). It writes a [world
        file](worlds.md) with an estimate of each parameter and its 90 % interval. The gel of every cell below was
        drawn, and the software was not given it. Width is that of the interval, over what nine of ten drawn cells span:
        at 100 % nothing is known that was not known before.
        """,
        "Cells of the bristle tier; the coverage furthest from 90 % first:",
        table(sorted(_rows(own), key=lambda row: -abs(row["holds"].value - 0.9)), *_COLUMNS),
        *_others(other),
        _refused(data["rows"]),
        "`make identify` plays the cells again and writes this page.",
    )


_COLUMNS = (
    ("parameter", "parameter"),
    ("90 % interval holds", "holds", ".0%"),
    ("width", "width", ".0%"),
    ("widest", "widest", ".0%"),
    ("cells that learn of it", "known", ".0%"),
)


def _rows(cells: Sequence[Row]) -> list[Row]:
    rows = []
    for one in PARAMETERS:
        gels = [row["gel"][one.key] for row in cells]
        widths = [gel["width"] for gel in gels]
        holds = wilson(sum(gel["holds"] for gel in gels), len(gels))
        known = sum(width < WIDEST for width in widths) / max(1, len(widths))
        rows.append(
            {
                "parameter": NAMES[one.key],
                "holds": holds,
                "width": float(np.median(widths)),
                "widest": max(widths),
                "known": known,
            }
        )
    return rows


def _others(other: Sequence[Row]) -> Sequence[str | Table]:
    if not other:
        return ()
    return (
        f"{len(other)} cells of the layer tier:",
        table(sorted(_rows(other), key=lambda row: -abs(row["holds"].value - 0.9)), *_COLUMNS),
    )


def _conclusion(own: Sequence[Row], other: Sequence[Row]) -> str:
    rows = _rows(own)
    missed = [row for row in rows if not ASKED[0] <= row["holds"].value <= ASKED[1]]
    asked = f"asked for: {100 * ASKED[0]:.0f} to {100 * ASKED[1]:.0f} %"
    lines = [f"90 % intervals of {row['parameter']} hold {row['holds']:.0%} of the truths" for row in missed]
    if other and not ASKED[0] <= _together(other).value <= ASKED[1]:
        lines.insert(0, f"in the layer tier all intervals together hold {_together(other):.0%}, not 90")
    first = f"**Missed:** {'; '.join(lines)}; {asked}.\n\n" if lines else ""
    return (
        f"{first}Reached: {len(rows) - len(missed)} of {len(rows)} parameters, in {len(own)} drawn cells of the bristle"
        f" tier; {asked}. All together their intervals hold {_together(own):.1%} of the truths."
    )


def _together(cells: Sequence[Row]) -> Estimate:
    holds = [gel["holds"] for row in cells for gel in row["gel"].values()]
    return wilson(sum(holds), len(holds))


def _refused(rows: Sequence[Row]) -> str:
    refused = [row for row in rows if "refused" in row]
    if not refused:
        return "None of the cells was refused."
    return "\n".join(
        [f"{len(refused)} of {len(rows)} cells were refused:\n", *(f"- {row['refused']}" for row in refused)]
    )
