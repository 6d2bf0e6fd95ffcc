"""Cells to collect from that are drawn whole: world and object of each re-fixture, over all that cells are.

Around one cell, what is known of it is as it is, and its object; the rest is drawn.

A trial of theirs is pressed to a fixed depth, whatever slips, with a frame every so many hundredths of a millimetre. So
cameras of all rates can be drawn from it when it is read; the arm's speed counts where the gel relaxes.
"""

import json
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from simulation.physics.quasistatic import QuasiStaticCell
from simulation.scene import drawn
from simulation.scene.rubber import shear_reach_pitches
from simulation.scene.scene import Scene, SceneError
from simulation.scene.state import Cell

NAME = "drawn"
KNOWN: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    NAME: {},
    "drawn-bristle": {"gel": {"tier": "bristle"}},
    "drawn-layer": {"gel": {"tier": "layer"}},
    "drawn-foreign": {"gel": {"relaxation_share": 0.0}, "grasp": {"finger_stiffness_n_per_mm": 0.0}},
}
"""In place of an object's name: what is not drawn. The first mixes the tiers; the others have one tier, or the finite
elements of the foreign cell, which know neither relaxation nor fingers that give way."""
PRESS_MM, FRAME_MM = 1.65, 0.15
LAYER_SHARE = 0.08
"""Of cells: a press of theirs costs several of the bristle tier's. Worlds that are judged on have half of each."""
GRIDS = ((12, 12), (12, 12), (16, 16), (20, 21))
"""Rows and columns of a pad's nodes, drawn alike: what a network learns must not be one grid's own pattern, and 12 x 12
cost a third of 20 x 21. The layer tier has the first."""
SETTLE_MM = 1e-4
"""Coarser than a judge's, a tenth of what a tracker sees."""
MOST_DRAWS = 1000
"""Of cells that do not fit together, until what is known of one must be what does not fit."""


def base(name: str = NAME) -> Scene:
    """What stands for all of them where a dataset names its scenes."""
    return drawn.scene_of_tables({"object": {"shape": "rectangle", "size_x_mm": 60.0, "size_y_mm": 50.0}}, name)


def mechanics(name: str) -> Callable[[Scene, int], Cell]:
    """What makes a cell's mechanics of a scene and a seed."""
    if name != "drawn-foreign":
        return QuasiStaticCell
    from simulation.foreign.cell import ForeignCell  # brings scipy and scikit-fem

    return ForeignCell


def draw_cell(
    rng: np.random.Generator, known: Mapping[str, Mapping[str, Any]] | None = None, held: Scene | None = None
) -> tuple[Scene, str]:
    """A scene, and all that was drawn of it as JSON by dotted key.

    known: tables of a world file, of what is not drawn; held: the object, instead of a drawn one. Raises SceneError
    where nothing that is drawn fits to them.
    """
    for _ in range(MOST_DRAWS):
        tables, body = drawn.draw_world(rng), {} if held else drawn.draw_object(rng)
        tables["gel"]["tier"] = "layer" if rng.random() < LAYER_SHARE else "bristle"
        for table, values in (known or {}).items():
            tables[table] = {**tables.get(table, {}), **values}
        try:
            world = drawn.world(tables, NAME)
            scene = world.around(held or drawn.scene_of_tables(body, NAME))
        except SceneError as error:
            misfit = str(error)
            continue  # the drawn parts do not fit together
        grid = int(rng.integers(len(GRIDS)))
        rows, columns = GRIDS[grid if tables["gel"]["tier"] == "bristle" else 0]
        numbers = {"gel.node_rows": rows, "gel.node_columns": columns, "numerics.settle_mm": SETTLE_MM}
        scene = scene.varied(numbers)
        return scene, json.dumps(_flat({**tables, **body}), sort_keys=True)
    raise SceneError(f"none of {MOST_DRAWS} drawn cells fits to what is known: {misfit}")


def stated(scene: Scene) -> dict[str, Any]:
    """What a trial says of its cell beside the JSON."""
    reach_mm = shear_reach_pitches(scene) * scene.sensor.marker_pitch_mm
    return {"speed_mm_s": scene.speed_mm_s, "grip_n": scene.grasp.force_n, "shear_reach_mm": reach_mm}


def _flat(tables: drawn.Tables) -> dict[str, Any]:
    return {f"{table}.{key}": value for table, values in tables.items() for key, value in values.items()}
