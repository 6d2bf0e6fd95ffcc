"""Drawn cells that press as in a commissioning: for fitting the posterior and for evaluating it."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robot_client.session.commission.run import PRESSES, second_grip_n
from robot_client.session.commission.wiring import SIDES
from service.contract import ContractError
from simulation.closed_loop.job import job_in
from simulation.scene import drawn
from simulation.scene.scene import SceneError
from simulation.scene.worlds import World, load_scene
from simulation.studies.episodes import Episode, play
from simulation.studies.identify import recorded
from simulation.studies.identify.evidence import Floats
from simulation.studies.pace.points import client, with_care
from simulation.studies.wiring import BEFORE_SIGNS


@dataclass(frozen=True)
class Cell:
    """A drawn cell with the rectangle that it presses, fully determined by its number."""

    number: int
    folder: Path
    models: Path
    tier: str = "bristle"

    @property
    def tables(self) -> drawn.Tables:
        """Its world, with the held object under `object`."""
        rng = np.random.default_rng((self.number, 0x1D))
        tables = drawn.draw_world(rng)
        tables["gel"]["tier"] = self.tier
        size = round(float(rng.uniform(*recorded.WIDTH_MM)), 1), round(float(rng.uniform(*recorded.DEPTH_MM)), 1)
        mass_kg = round(math.exp(float(rng.uniform(math.log(0.05), math.log(0.6)))), 3)
        body = {"shape": "rectangle", "size_x_mm": size[0], "size_y_mm": size[1], "mass_kg": mass_kg}
        return {**tables, "object": body}


def pressed(cell: Cell) -> dict[str, Any]:
    """In a worker: the cell's ground truth, and the numbers from its probes or why there are none."""
    tables = cell.tables
    row: dict[str, Any] = {"number": cell.number, "tables": tables}
    try:
        return {**row, "numbers": _probed(cell, tables).tolist()}
    except (ContractError, SceneError) as error:
        return {**row, "refused": str(error)}


def _probed(cell: Cell, tables: drawn.Tables) -> Floats:
    world = drawn.world({name: table for name, table in tables.items() if name != "object"}, f"cell-{cell.number}")
    cell.folder.mkdir(parents=True, exist_ok=True)
    body = cell.folder / "object.toml"
    body.write_text(drawn.toml({"object": tables["object"]}, "what a drawn cell presses"), encoding="utf-8")
    scene, own = load_scene(body), float(world.changes["grasp.force_n"])
    kinds = ((own, SIDES, False), (own, PRESSES, True), (second_grip_n(own), PRESSES, True))
    for group, (grip_n, starts, until_slip) in enumerate(kinds):
        for index, start in enumerate(starts):
            job = _job(cell, world, body, (start, index, group), grip_n)
            play(Episode(cell.folder / f"{group}{index}", cell.models, job, until_slip=until_slip))
    return recorded.read(cell.folder).numbers(scene)


def _job(
    cell: Cell, world: World, body: Path, which: tuple[tuple[float, float], int, int], grip_n: float
) -> dict[str, Any]:
    start, index, group = which
    tables = dict(with_care(client(), world, str(body), None))
    job = job_in(world, str(body), index, start, cell.number * 16 + group * 4 + index, client=tables, **BEFORE_SIGNS)
    return {**job, "changes": {**job["changes"], "grasp.force_n": grip_n}}
