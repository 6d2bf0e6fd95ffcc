"""docs/identify.md from identify.json: what probes reveal about a gel, missed targets first."""

from collections.abc import Sequence

import numpy as np

from reporting.page import page
from reporting.statistics import Estimate, clustered, wilson
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
    "relaxation_share": "relaxation share",
    "relaxation_s": "relaxation time",
    "shear_reach_mm": "shear reach",
}


def identify_page(data: Row) -> str:
    scored = [row for row in data["rows"] if "gel" in row]
    own = [row for row in scored if row["tier"] == "bristle"]
    other = [row for row in scored if row["tier"] != "bristle"]
    return page(
        "# What a cell's probes reveal about its gel, simulated",
        _conclusion(own, other),
        """
        ## How it was measured

        `scene identify` reads the recordings of a commissioning: the four probes that test the signs, and two presses
        until slip at each of two grip forces ([why](decisions/0175-what-a-press-tells.md)). It writes a [world
        file](worlds.md) with an estimate and a 90 % interval of each parameter. The gel of every cell below was drawn
        and not given to the software. The width of an interval is relative to the range of nine of ten drawn cells:
        100 % means that the probes add nothing.

        Cells of the bristle tier, the coverage furthest from 90 % first:
        """,
        _table(own),
        *((f"{len(other)} cells of the layer tier, sorted likewise:", _table(other)) if other else ()),
        _refused(data["rows"]),
        data["note"],
        "`make identify` plays the cells again and writes this page.",
    )


def _table(cells: Sequence[Row]) -> Table:
    return table(
        sorted(_rows(cells), key=lambda row: -abs(row["holds"].value - 0.9)),
        ("parameter", "parameter"),
        ("90 % coverage", "holds", ".0%"),
        ("median width", "width", ".0%"),
        ("max width", "widest", ".0%"),
        ("cells that learn it", "known", ".0%"),
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


def _conclusion(own: Sequence[Row], other: Sequence[Row]) -> str:
    rows = _rows(own)
    missed = [row for row in rows if not ASKED[0] <= row["holds"].value <= ASKED[1]]
    asked = f"target: {100 * ASKED[0]:.0f} to {100 * ASKED[1]:.0f} %"
    lines = [f"{row['parameter']} {row['holds']:.0%}" for row in missed]
    if other and not ASKED[0] <= _together(other).value <= ASKED[1]:
        lines.insert(0, f"all parameters together in the layer tier {_together(other):.0%}")
    first = f"**Missed** coverage of the 90 % intervals ({asked}): {'; '.join(lines)}.\n\n" if lines else ""
    return (
        f"{first}Reached: {len(rows) - len(missed)} of {len(rows)} parameters in {len(own)} drawn cells of the bristle "
        f"tier. The intervals of all parameters together cover {_together(own):.1%} of the true values."
    )


def _together(cells: Sequence[Row]) -> Estimate:
    """Of a cell, all parameters may be wrong at once."""
    gels = [row["gel"].values() for row in cells]
    return clustered([sum(gel["holds"] for gel in one) for one in gels], [len(one) for one in gels])


def _refused(rows: Sequence[Row]) -> str:
    refused = [row for row in rows if "refused" in row]
    if not refused:
        return "None of the cells was refused."
    return "\n".join(
        [f"{len(refused)} of {len(rows)} cells were refused:\n", *(f"- {row['refused']}" for row in refused)]
    )
