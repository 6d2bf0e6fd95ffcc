"""From a scene's keys to the constants of the compiled kernels."""

from typing import Any

import numpy as np

from simulation.physics.kernels import records
from simulation.physics.pads import Pad
from simulation.scene.effects import Active
from simulation.scene.scene import GRAVITY_N_PER_KG, Scene

TANGENTIAL_RATIO = 0.5  # block contact: tangential over normal stiffness
BASE_K = 2000.0  # a block's base corner on the table, N/mm


def scene_constants(scene: Scene, active: Active, pad: Pad) -> records.Records:
    """Constants record [1] of a scene, without the effects that are off."""
    body, blocks, pads = scene.object, scene.blocks, scene.gel
    area = pad.height_mm * pad.width_mm / (pads.node_rows * pads.node_columns)
    shear = pads.shear_modulus_n_per_mm2 / pads.thickness_mm
    values: dict[str, Any] = {
        "area": area,
        "kn": shear * pads.normal_ratio,
        "kt": shear,
        "friction": pads.friction,
        "profile": body.held_profile,
        "bottom": -scene.grasp.height_mm,
        "weight": body.mass_kg * GRAVITY_N_PER_KG if active.gravity else 0.0,
        "mass_height": body.centre_of_mass_height_mm - scene.grasp.height_mm,
        "contact_k": blocks.stiffness_n_per_mm,
        "ratio": TANGENTIAL_RATIO,
        "edge_friction": blocks.friction if active.edge_friction else 0.0,
        "block_size": (blocks.size_x_mm, blocks.size_y_mm, blocks.height_mm),
        "block_weight": blocks.mass_kg * GRAVITY_N_PER_KG,
        "base_k": BASE_K,
        "table_friction": blocks.table_friction,
        "unknowns": 18 if active.free_blocks else 6,
    }
    if (faces := body.held_faces) is not None:
        values |= {"faceted": 1, "faces": faces}
    out = np.zeros(1, dtype=records.CONSTANTS)
    for name, value in values.items():
        out[name][0] = value
    return out
