"""Page of what a third party says of the finite elements, and of what accuracy costs in time."""

from collections.abc import Mapping
from typing import Any

from reporting.page import page
from reporting.statistics import number
from reporting.table import table

Row = dict[str, Any]
FORCE, FIELD, SLIP_POINTS = 0.03, 0.05, 5.0


def foreign_check_page(data: Row) -> str:
    probes = [row for row in data["probes"] if "failed" not in row]
    lost = [row["kind"] for row in data["probes"] if "failed" in row]
    beyond = [row for row in probes if not _within(row)]
    return page(
        f"""
        # What CalculiX says of the finite elements, simulated

        **{len(beyond)} of {len(probes)} probes are not within all limits** (force {number(FORCE, ".0%")},
        displacement {number(FIELD, ".0%")} RMS, slip share {SLIP_POINTS:g} points). The worst: force across the pad
        {_worst(probes, "normal_apart")}, shear {_worst(probes, "shear_apart")}, displacement
        {_worst(probes, "moved_apart")}, slip share {max(map(_points, probes)):.0f} points.
        """,
        data.get("note", ""),
        """
        The [foreign cell](decisions/0070-a-foreign-cell-of-finite-elements.md) plays each probe: a flat box is gripped,
        carried or set down on the edges of the gap. Where the box was in the hand, load step by load step, is given to
        CalculiX 2.20, where a rigid plate goes the same way on the same pad: serendipity bricks with reduced
        integration against our quadratic ones with linear pressures, surface-to-surface penalty contact against exact
        contact at nodes, its own iteration and increments. Compared are the force of the plate, the displacement of
        the face (RMS, by area) and the share of nodes where friction is at its limit. "Inside" leaves out the nodes
        on the face's rim.
        """,
        table(probes, *_PROBE),
        f"CalculiX found no end of {len(lost)} more ({', '.join(lost)})." if lost else "",
        *(_COSTS if data["costs"] else ()),
        table(data["costs"], *_COST) if data["costs"] else "",
        *(_STRAINS if data["large"] else ()),
        table(data["large"], *_LARGE) if data["large"] else "",
        data.get("lacks", ""),
        f"""
        ## Hard probes

        {_hard(data["hard"]) if data["hard"] else "None were played."}

        Made by `python -m simulation foreign-check --out docs`, and the last by `hard-probes --tier foreign`.
        """,
    )


def _within(row: Row) -> bool:
    force = max(row["normal_apart"], row["shear_apart"])
    return bool(force <= FORCE and row["moved_apart"] <= FIELD and _points(row) <= SLIP_POINTS)


def _points(row: Row) -> float:
    return float(100.0 * abs(row["slip"][0] - row["slip"][1]))


def _worst(rows: list[Row], name: str) -> str:
    return number(max(row[name] for row in rows), ".1%")


def _hard(hard: Mapping[str, Any]) -> str:
    ended = ", ".join(f"{count} {how}" for how, count in hard["ended"].items())
    return (
        f"Of {hard['probes']} random hard descents as in [hard probes](hard_probes.md), in a gel that ends 1 mm beyond "
        f"the markers with Poisson's ratio 0.48: {ended}. Not one number was not finite; the worst residual is "
        f"{hard['worst_residual_n']:.1e} N (limit 1e-6)."
    )


_COSTS = (
    "## Mesh, load step, and what each tier costs",
    """
    A descent of 1.2 mm on an edge in four parts. Errors are those of its end against the finest (8 x 8 x 3 elements,
    load step 0.085 mm). The stop depth is where a quarter of the contact slips. CPU time is that of the descent.
    """,
)
_STRAINS = (
    "## What it does not have",
    "Strains are small. CalculiX with Neo-Hooke's rubber and finite motion, on the same paths, says how much that is:",
)
_PROBE: tuple[Any, ...] = (
    ("probe", "kind"),
    ("Poisson", "poisson_ratio", ".2f"),
    ("thick mm", "thickness_mm", ".1f"),
    ("margin mm", lambda row: row["changes"].get("gel.margin_mm", ["endless"])[0]),
    ("depth mm", "depth_mm", ".1f"),
    ("across N", lambda row: abs(row["force_n"][1][1]), ".2f"),
    ("apart", "normal_apart", ".1%"),
    ("shear N", "shear_n", ".2f"),
    ("apart", "shear_apart", ".1%"),
    ("moved RMS mm", "moved_rms_mm", ".3f"),
    ("apart", "moved_apart", ".1%"),
    ("inside", "moved_apart_inside", ".1%"),
    ("slips, ours", lambda row: row["slip"][0], ".0%"),
    ("slips, CalculiX", lambda row: row["slip"][1], ".0%"),
)
_COST: tuple[Any, ...] = (
    ("scene", "scene"),
    ("cell", "cell"),
    ("CPU ms", "cpu_ms", ".0f"),
    ("force N", "force_n", ".2f"),
    ("of N", "of_n", ".1f"),
    ("turn deg", "turn_deg", ".3f"),
    ("markers um", "markers_um", ".0f"),
    ("slip share", "slip", "+.0%"),
    ("stop depth mm", "stop_mm", "+.2f"),
)
_LARGE: tuple[Any, ...] = (
    ("probe", "kind"),
    ("pressed in, of the thickness", "strain", ".0%"),
    ("across", "normal", "+.1%"),
    ("shear", "shear", "+.1%"),
    ("displacement", "moved", ".1%"),
)
