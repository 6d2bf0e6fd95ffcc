"""The pads of a scene before the grasp: their size, their nodes, their stiffness, and the extent of the gel beyond."""

import math
from typing import NamedTuple

import numpy as np

from simulation.physics import bonded_block, elastic_layer, shape_factor
from simulation.physics.elastic_layer import Kernel
from simulation.physics.kernels import bristles
from simulation.physics.kernels.records import Records
from simulation.scene.effects import Active
from simulation.scene.rubber import margin_beyond_mm, poisson_of, poisson_ratio
from simulation.scene.scene import Scene


class Pad(NamedTuple):
    """The touchable part of a gel, mm: height (along v), width (along u), and the extent of the gel beyond it, (u, v).

    flows: whether its edges or its Poisson's ratio are stated, so that the directions in which rubber can flow matter.
    """

    height_mm: float
    width_mm: float
    beyond_mm: tuple[float, float]
    poisson: float
    flows: bool


def pad_of(scene: Scene, active: Active) -> Pad:
    """The pad of the sensor's profile, or all of a gel that ends before it. Endless gels have no edge."""
    height, width = scene.sensor.gel_height_mm, scene.sensor.gel_width_mm
    poisson = poisson_of(scene) if active.poisson else poisson_ratio(max(scene.gel.normal_ratio, 2.0))
    beyond = margin_beyond_mm(scene) if active.gel_edges else None
    if beyond is None:
        return Pad(height, width, (math.inf, math.inf), poisson, active.poisson and scene.gel.poisson_ratio is not None)
    u, v = beyond
    return Pad(height + 2.0 * min(v, 0.0), width + 2.0 * min(u, 0.0), (max(u, 0.0), max(v, 0.0)), poisson, flows=True)


def nodes_of(scene: Scene, pad: Pad) -> Records:
    """The bristles of both pads; near free edges, to which rubber can flow, they are softer."""
    gel = scene.gel
    nodes = bristles.make_nodes(gel.node_rows, gel.node_columns, pad.height_mm, pad.width_mm, gel.crown_mm)
    if gel.tier == "bristle" and pad.flows:
        u = (np.arange(gel.node_columns) + 0.5) * pad.width_mm / gel.node_columns - 0.5 * pad.width_mm
        v = (np.arange(gel.node_rows) + 0.5) * pad.height_mm / gel.node_rows - 0.5 * pad.height_mm
        ends = [shape_factor.borne_beyond_mm(beyond, gel.thickness_mm) for beyond in pad.beyond_mm]
        half = 0.5 * pad.width_mm + ends[0], 0.5 * pad.height_mm + ends[1]
        moduli = shape_factor.modulus_profile(u, v, half, gel.thickness_mm, pad.poisson)
        nodes["stiff"] = np.tile(moduli.ravel() / gel.normal_ratio, 2)
    return nodes


def kernel_of(scene: Scene, pad: Pad) -> Kernel:
    """The layer tier's compliance."""
    gel = scene.gel
    grid = elastic_layer.Grid(
        gel.node_rows, gel.node_columns, pad.height_mm / gel.node_rows, pad.width_mm / gel.node_columns
    )
    if math.isfinite(max(pad.beyond_mm)):
        layer = (gel.thickness_mm, gel.shear_modulus_n_per_mm2, pad.poisson)
        return bonded_block.EdgedLayer(grid, *layer, pad.beyond_mm)
    return elastic_layer.bonded_layer(grid, gel.thickness_mm, gel.shear_modulus_n_per_mm2, pad.poisson)
