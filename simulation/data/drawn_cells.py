"""Completely drawn cells to collect from: world and object of each re-fixture, over the full range of cells.

Around one known cell, its known parameters and its object are kept, and the rest is drawn.

A trial in a drawn cell is pressed to a fixed depth regardless of slip, with frames in equal steps of depth (some
hundredths of a millimetre). Cameras of all rates can therefore be drawn from it at read time; the arm's speed matters
only where the gel relaxes.
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
"""Names that stand for an object's, each with the parameters that are fixed. The first mixes the tiers; the others have
one tier, or the finite elements of the foreign cell, without relaxation and compliant fingers."""
PRESS_MM, FRAME_MM = 1.65, 0.15
LAYER_SHARE = 0.08
"""Share of cells in the layer tier, whose presses cost several times as much. Worlds for evaluation: half of each."""
GRIDS = ((12, 12), (12, 12), (16, 16), (20, 21))
"""Rows and columns of a pad's nodes, drawn uniformly, so that a network does not learn one grid's pattern.

12 x 12 costs a third of 20 x 21. The layer tier uses the first.
"""
SETTLE_MM = 1e-4
"""Coarser than for evaluation; a tenth of what a tracker resolves."""
MOST_DRAWS = 1000
"""Draws of inconsistent cells before the known parameters themselves are rejected as inconsistent."""


def base(name: str = NAME) -> Scene:
    """The scene that stands for all drawn cells where a dataset names its scenes."""
    return drawn.scene_of_tables({"object": {"shape": "rectangle", "size_x_mm": 60.0, "size_y_mm": 50.0}}, name)


def mechanics(name: str) -> Callable[[Scene, int], Cell]:
    """The class that simulates these cells, called with a scene and a seed."""
    if name != "drawn-foreign":
        return QuasiStaticCell
    from simulation.foreign.cell import ForeignCell  # brings scipy and scikit-fem

    return ForeignCell


def draw_cell(
    rng: np.random.Generator, known: Mapping[str, Mapping[str, Any]] | None = None, held: Scene | None = None
) -> tuple[Scene, str]:
    """A scene, and all its drawn parameters as JSON by dotted key.

    known: tables of a world file, not drawn; held: the object, instead of a drawn one. Raises SceneError if no draw is
    consistent with them.
    """
    for _ in range(MOST_DRAWS):
        tables, body = drawn.draw_world(rng), {} if held else drawn.draw_object(rng)
        tables["gel"]["tier"] = "layer" if rng.random() < LAYER_SHARE else "bristle"
        if "normal_ratio" in (known or {}).get("gel", {}):
            del tables["gel"]["poisson_ratio"]  # a drawn one would replace what is known
        for table, values in (known or {}).items():
            tables[table] = {**tables.get(table, {}), **values}
        try:
            world = drawn.world(tables, NAME)
            scene = world.around(held or drawn.scene_of_tables(body, NAME))
        except SceneError as error:
            misfit = str(error)
            continue  # inconsistent draws
        grid = int(rng.integers(len(GRIDS)))
        rows, columns = GRIDS[grid if tables["gel"]["tier"] == "bristle" else 0]
        numbers = {"gel.node_rows": rows, "gel.node_columns": columns, "numerics.settle_mm": SETTLE_MM}
        scene = scene.varied(numbers)
        return scene, json.dumps(_flat({**tables, **body}), sort_keys=True)
    raise SceneError(f"none of {MOST_DRAWS} drawn cells fits to what is known: {misfit}")


def stated(scene: Scene) -> dict[str, Any]:
    """Fields of a trial about its cell, besides the JSON."""
    reach_mm = shear_reach_pitches(scene) * scene.sensor.marker_pitch_mm
    return {"speed_mm_s": scene.speed_mm_s, "grip_n": scene.grasp.force_n, "shear_reach_mm": reach_mm}


def _flat(tables: drawn.Tables) -> dict[str, Any]:
    return {f"{table}.{key}": value for table, values in tables.items() for key, value in values.items()}
