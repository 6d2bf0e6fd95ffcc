"""The sealed test: worlds and starts follow from the released networks' own bytes, so that nobody can choose them.

Played in the cell of finite elements. Our own tiers, an earlier release and the oracle also play the first starts.
"""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from simulation.closed_loop.benchmark import figures
from simulation.closed_loop.campaign import Task
from simulation.closed_loop.statistics import Row
from simulation.scene import drawn
from simulation.scene.worlds import load_scene
from simulation.studies.drawn_worlds import Start, starts

WORLDS, EACH = 100, 5  # worlds of a family, and consecutive insertions in each of them
RUBBER = {
    "gel.poisson_ratio": (0.82, 1.0),
    "gel.relaxation_share": (0.0, 0.0),
    "grasp.finger_stiffness_n_per_mm": (0.0, 0.0),
}
"""Shares of the ranges of `drawn.QUANTITIES`: ratios from 0.45 on; no gel relaxes and no finger bends.

The cell had neither when the families were fixed, and releases are compared by them.
"""
MARGINS = ("gel.margin_x_mm", "gel.margin_z_mm")
FAMILIES: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "edges near": {**RUBBER, **dict.fromkeys(MARGINS, (0.0, 0.35))},
    "edges far": {**RUBBER, **dict.fromkeys(MARGINS, (0.8, 1.0))},
    "stiff and slippery": {**RUBBER, "reach": (0.0, 0.3), "friction": (0.0, 0.3)},
}
WITNESS = "finite elements"
ALIKE = "the same starts"  # of WITNESS, where a comparison plays fewer
FOREIGN = {"cell": "foreign"}
BESIDE: Mapping[str, Mapping[str, str]] = {
    "bristle": {},
    "layer": {},
    "older": FOREIGN,
    "recipe": {**FOREIGN, "controller": "heuristic", "perception": "pictures"},
    "oracle": {**FOREIGN, "controller": "oracle"},
}
"""The comparisons, and fields of their jobs: tiers of our own physics; in the elements other deciders."""


class Opened(NamedTuple):
    """One start of the test: its family and its insertion."""

    family: str
    start: Start


def seal(models: Path, counter: int) -> str:
    """SHA-256, hex, of every network in a folder and below it, and of a counter."""
    digest = hashlib.sha256(f"{counter}".encode())
    for file in sorted(models.rglob("*.onnx")):
        digest.update(file.relative_to(models).as_posix().encode() + hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def seed_of(sealed: str, *parts: str) -> int:
    """A seed for one draw of a sealed test."""
    return int(hashlib.sha256(" ".join((sealed, *parts)).encode()).hexdigest()[:12], 16)


def opened(sealed: str, objects: Sequence[str], count: int) -> list[Opened]:
    """``count`` starts per family, at most WORLDS * EACH, families in turn by world; a larger test extends it."""
    by_family = {}
    for family, within in FAMILIES.items():
        seed = seed_of(sealed, family)
        tables = drawn.draw_worlds(WORLDS, seed, within)
        for each in tables:
            each["gel"]["tier"] = "bristle"
        worlds = [drawn.world(each, f"{family} {number}") for number, each in enumerate(tables)]
        by_family[family] = starts([world for world in worlds for _ in range(EACH)], objects, count, seed)
    return [
        Opened(family, start)
        for first in range(0, count, EACH)
        for family, begun in by_family.items()
        for start in begun[first : first + EACH]
    ]


def tasks(sealed: str, models: Path, begun: Sequence[Opened], cell: str) -> list[Task]:
    """Every start in one cell: WITNESS or one of BESIDE."""
    return [Task(models, _job(seed_of(sealed) + index, index, start, cell)) for index, (_, start) in enumerate(begun)]


def _job(seed: int, index: int, start: Start, cell: str) -> dict[str, Any]:
    fields = FOREIGN if cell == WITNESS else BESIDE[cell]
    changes = {**start.world.changes, **({} if fields else {"gel.tier": cell})}
    more = {"condition": f"{start.world.name}: {cell}", "changes": changes, "cell": "", **fields}
    return start.job(index, seed, **more)


def report_of(played: Mapping[str, Sequence[Row]], begun: Sequence[Opened], setup: Row) -> Row:
    """The page's data: the figures of each cell, in the elements also by family, and every failure there.

    ``played``: the rows of WITNESS of all of ``begun``, and those of others, maybe only of its first ones.
    """
    families, least = [each.family for each in begun], min(map(len, played.values()))
    alike = {ALIKE: played[WITNESS][:least]} if least < len(begun) else {}
    shown = {WITNESS: played[WITNESS], **alike, **played}
    return {
        "simulated": True,
        **setup,
        "figures": [row for cell, rows in shown.items() for row in _figures(cell, rows, families)],
        "failed": [row for row in table_of({WITNESS: played[WITNESS]}, begun) if not row["inserted"]],
    }


def table_of(played: Mapping[str, Sequence[Row]], begun: Sequence[Opened]) -> list[Row]:
    """A row of plain values for every insertion."""
    return [
        {"cell": cell, **_compact(*pair)} for cell, rows in played.items() for pair in zip(rows, begun, strict=False)
    ]


def _figures(cell: str, rows: Sequence[Row], families: Sequence[str]) -> Iterator[Row]:
    for family in ("all", *(FAMILIES if cell == WITNESS else ())):
        mine = [row for row, of in zip(rows, families, strict=False) if family in ("all", of)]
        yield {"cell": cell, "family": family, **figures(mine)}


def _compact(row: Row, each: Opened) -> Row:
    body = load_scene(row["scene"]).object
    kept = ("attempts", "inserted", "claimed", "in_gap", "void", "grasp_kept", "reason", "shortfalls")
    return {
        "world": each.start.world.name,
        "object": f"{body.shape} {body.size_x_mm:.0f} x {body.size_y_mm:.0f} mm, {body.mass_kg:g} kg",
        "start_x_mm": round(each.start.x_mm, 2),
        "start_yaw_deg": round(each.start.theta_deg, 2),
        "reach_pitches": round(each.start.reach_pitches, 3),
        **{name: row[name] for name in kept},
        "end_x_mm": round(row["final_error"][0], 2),
        "end_yaw_deg": round(row["final_error"][1], 2),
        "force_n": round(row["course"]["force_n"], 1),
        "block_mm": round(row["course"]["block_mm"], 2),
    }
