"""Which of the physics' functions run: the kernels as plain Python, pads of 4 x 4 nodes, one short poke.

Run as a module; prints JSON: effect -> [calls of its own functions when on, when off].
"""

import json
import os
import sys
from collections import Counter
from collections.abc import Callable
from typing import Any

os.environ["NUMBA_DISABLE_JIT"] = "1"

import numpy as np

from simulation.data.probe import QuasiStaticCell
from simulation.physics.kernels import load_step
from simulation.scene.worlds import load_scene

OWN = {
    "gravity": ("_gravity",),
    "inertia": ("_inertia", "ride", "duration_s", "step", "arrive"),
    "edge_friction": ("_add_slide",),
    "free_blocks": ("find_bases", "_block_weights"),
    "gel_coupling": ("_bulged",),
    "poisson": ("normal_ratio",),
    "gel_edges": ("borne_beyond_mm",),
    "relaxation": ("crept",),
    "finger_compliance": ("_bend_fingers",),
}
ROUGH = {"gel__node_rows": 4, "gel__node_columns": 4, "numerics__load_step_mm": 0.5, "numerics__residual_n": 1e-4}

SOFT = {
    "gel__poisson_ratio": 0.45,
    "gel__margin_mm": (0.0, 0.0),
    "gel__relaxation_share": 0.3,
    "grasp__finger_stiffness_n_per_mm": 50.0,
}


def plain(kernel: Callable[..., Any]) -> Callable[..., Any]:
    """The kernel with record arrays whose fields are attributes, as numba sees them."""

    def view(argument: Any) -> Any:
        if isinstance(argument, tuple):
            return type(argument)(*map(view, argument))
        has_fields = isinstance(argument, np.ndarray) and argument.dtype.names
        return argument.view(np.recarray) if has_fields else argument

    def call(*arguments: Any) -> Any:
        return kernel(*map(view, arguments))

    return call


def calls(**switches: str) -> Counter[str]:
    """Names of the simulator's functions called in a poke, with their counts."""
    counts: Counter[str] = Counter()

    def count(frame: Any, event: str, _: object) -> None:
        if event == "call" and "simulation" in frame.f_code.co_filename:
            counts[frame.f_code.co_name] += 1

    sys.setprofile(count)
    cell = QuasiStaticCell(load_scene("rectangle", **ROUGH, **SOFT, **switches))
    cell.regrasp(8.0, 5.0)
    cell.move_to(cell.pose[0], 0.0, cell.pose[2] - 5.3, 5.0)
    sys.setprofile(None)
    return counts


def main() -> None:
    load_step.advance, load_step.grip_pressures = plain(load_step.advance), plain(load_step.grip_pressures)
    counts = [calls(**{f"effects__{key}": switch for key in OWN}) for switch in ("on", "off")]
    print(json.dumps({key: [sum(count[name] for name in own) for count in counts] for key, own in OWN.items()}))


if __name__ == "__main__":
    main()
