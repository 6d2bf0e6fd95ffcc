"""The sealed test: worlds and starts that follow from the released networks' own bytes, so that nobody chooses them.

Played in the cell of finite elements, and in our own tiers beside it from the same starts.
"""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from simulation.closed_loop.benchmark import first_answers
from simulation.closed_loop.campaign import Task
from simulation.closed_loop.job import job_in
from simulation.closed_loop.statistics import Row, ends
from simulation.scene import drawn
from simulation.scene.worlds import load_scene
from simulation.studies.drawn_worlds import Start, starts

WORLDS, EACH = 100, 5  # worlds of a family, and insertions in a row in each of them
RUBBER = {
    "gel.poisson_ratio": (0.82, 1.0),
    "gel.relaxation_share": (0.0, 0.0),
    "grasp.finger_stiffness_n_per_mm": (0.0, 0.0),
}
"""Shares of the ranges of `drawn.QUANTITIES`: ratios from 0.45 on; the cell has no viscosity and no soft fingers."""
MARGINS = ("gel.margin_x_mm", "gel.margin_z_mm")
FAMILIES: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "edges near": {**RUBBER, **dict.fromkeys(MARGINS, (0.0, 0.35))},
    "edges far": {**RUBBER, **dict.fromkeys(MARGINS, (0.8, 1.0))},
    "stiff and slippery": {**RUBBER, "reach": (0.0, 0.3), "friction": (0.0, 0.3)},
}
WITNESS = "finite elements"


class Opened(NamedTuple):
    """One start of the test: its family and what there is to play."""

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
    """``count`` starts a family, at most WORLDS * EACH, families in turn by world; more of them begin alike."""
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


def tasks(sealed: str, models: Path, begun: Sequence[Opened], cells: Sequence[str]) -> list[Task]:
    """Every start in every cell: WITNESS or a tier of our own physics."""
    return [
        Task(models, _job(seed_of(sealed) + index, index, start, cell))
        for cell in cells
        for index, (_, start) in enumerate(begun)
    ]


def _job(seed: int, index: int, start: Start, cell: str) -> dict[str, Any]:
    own = cell != WITNESS
    changes = {**start.world.changes, **({"gel.tier": cell} if own else {})}
    at, title = (start.x_mm, start.theta_deg), f"{start.world.name}: {cell}"
    options = {"condition": title, "changes": changes, "cell": "" if own else "foreign"}
    return job_in(start.world, start.scene, index, at, seed, **options)


def report_of(rows: Sequence[Row], begun: Sequence[Opened], cells: Sequence[str], setup: Row) -> Row:
    """What the page is written from: every insertion, and the figures of each cell and family."""
    by_cell = {cell: rows[place * len(begun) : (place + 1) * len(begun)] for place, cell in enumerate(cells)}
    return {
        "simulated": True,
        **setup,
        "figures": list(_figures(by_cell, [each.family for each in begun])),
        "insertions": {cell: [_compact(row, each) for row, each in zip(mine, begun, strict=True)]
                       for cell, mine in by_cell.items()},
    }  # fmt: skip


def _figures(by_cell: Mapping[str, Sequence[Row]], families: Sequence[str]) -> Iterator[Row]:
    for cell, rows in by_cell.items():
        for family in ("all", *FAMILIES):
            mine = [row for row, of in zip(rows, families, strict=True) if family in ("all", of)]
            yield {"cell": cell, "family": family, **ends(mine), **first_answers(mine),
                   "worst_force_n": max(row["course"]["force_n"] for row in mine)}  # fmt: skip


def _compact(row: Row, each: Opened) -> Row:
    body = load_scene(row["scene"]).object
    kept = ("attempts", "inserted", "claimed", "in_gap", "void", "grasp_kept", "reason", "shortfalls")
    return {
        "world": each.start.world.name,
        "object": f"{body.shape} {body.size_x_mm:.0f} x {body.size_y_mm:.0f} mm, {body.mass_kg:g} kg",
        "start": [round(each.start.x_mm, 2), round(each.start.theta_deg, 2)],
        "reach_pitches": round(each.start.reach_pitches, 3),
        **{name: row[name] for name in kept},
        "final_error": [round(value, 2) for value in row["final_error"]],
        "force_n": round(row["course"]["force_n"], 1),
        "block_mm": round(row["course"]["block_mm"], 2),
    }
