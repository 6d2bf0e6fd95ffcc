"""Page of the comparison of the finite elements with CalculiX, and of what accuracy costs in time."""

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
        # The finite elements compared with CalculiX, simulated

        **{len(beyond)} of {len(probes)} probes exceed at least one limit** (force {number(FORCE, ".0%")}, displacement
        {number(FIELD, ".0%")} RMS, slip share {SLIP_POINTS:g} points). The largest differences are
        {_worst(probes, "normal_apart")} in the force across the pad, {_worst(probes, "shear_apart")} in shear,
        {_worst(probes, "moved_apart")} in displacement and {max(map(_points, probes)):.0f} points in the slip share.

        ## How it was measured

        The [foreign cell](decisions/0070-a-foreign-cell-of-finite-elements.md) grips, carries or sets down a flat box
        on the edges of the gap. CalculiX 2.20 moves a rigid plate along the same path, load step by load step, on the
        same pad, with its own solver. It has serendipity bricks with reduced integration, where ours are quadratic
        with linear pressures, and surface-to-surface penalty contact, where ours is exact at nodes.

        The table compares the force of the plate, the displacement of the face (RMS by area) and the share of nodes
        where friction is at its limit. "Inside" excludes the nodes on the rim of the face.
        """,
        table(probes, *_PROBE),
        f"CalculiX did not converge on {len(lost)} more ({', '.join(lost)})." if lost else "",
        data.get("note", ""),
        *(_COSTS if data["costs"] else ()),
        table(data["costs"], *_COST) if data["costs"] else "",
        *(_STRAINS if data["large"] else ()),
        table(data["large"], *_LARGE) if data["large"] else "",
        data.get("lacks", ""),
        f"""
        ## Hard probes

        {_hard(data["hard"]) if data["hard"] else "None was played."}

        Made by `python -m simulation foreign-check --out docs`; the hard probes by `hard-probes --tier foreign`.
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
    ended = ", ".join(f"{count:,} {how}" for how, count in hard["ended"].items())
    return (
        f"{hard['probes']:,} random descents as in [hard probes](hard_probes.md), in a gel that ends 1 mm beyond the "
        f"markers and has a Poisson's ratio of 0.48, ended as follows: {ended}. Every number was finite. The worst "
        f"residual is {hard['worst_residual_n']:.1e} N (limit 1e-6)."
    )


_COSTS = (
    "## Mesh, load step and cost of each tier",
    """
    A descent of 1.2 mm on an edge, in four parts, with its CPU time. Errors are those at its end against the finest
    mesh (8 x 8 x 3 elements, load step 0.085 mm). At the stop depth a quarter of the contact slips.
    """,
)
_STRAINS = (
    "## What the finite elements leave out",
    """
    The elements assume small strains. What CalculiX gets on the same paths with neo-Hookean rubber and finite
    deformation:
    """,
)
_PROBE: tuple[Any, ...] = (
    ("probe", "kind"),
    ("Poisson's ratio", "poisson_ratio", ".2f"),
    ("thickness mm", "thickness_mm", ".1f"),
    ("margin mm", lambda row: row["changes"].get("gel.margin_mm", ["endless"])[0]),
    ("depth mm", "depth_mm", ".1f"),
    ("normal N", lambda row: abs(row["force_n"][1][1]), ".2f"),
    ("diff", "normal_apart", ".1%"),
    ("shear N", "shear_n", ".2f"),
    ("diff", "shear_apart", ".1%"),
    ("displacement RMS mm", "moved_rms_mm", ".3f"),
    ("diff", "moved_apart", ".1%"),
    ("diff inside", "moved_apart_inside", ".1%"),
    ("slip share, ours", lambda row: row["slip"][0], ".0%"),
    ("slip share, CalculiX", lambda row: row["slip"][1], ".0%"),
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
    ("strain across", "strain", ".0%"),
    ("normal force", "normal", "+.1%"),
    ("shear force", "shear", "+.1%"),
    ("displacement", "moved", ".1%"),
)
