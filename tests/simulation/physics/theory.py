"""The simulator against theory, always through the whole cell.

Hertz, Cattaneo-Mindlin and Winkler: a heavy flat box hangs between two paraboloid pads, and its weight is the
tangential load (Johnson, Contact Mechanics, 1985, 4.22-4.24 and 7.38-7.42; on bristles the stick radius is
c / a = (1 - Q / (mu P))^(1/4)). Geometry: the share of uniformly drawn errors that insert at once.
"""

import math
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reporting.page import page, publish
from reporting.statistics import Estimate, wilson
from reporting.table import table
from simulation.physics import elastic_layer
from simulation.physics.kernels import bristles
from simulation.physics.quasistatic import QuasiStaticCell
from simulation.scene.worlds import load_scene
from tests.simulation.physics import half_space as kernels
from tests.simulation.scenes import UPRIGHT

Floats = NDArray[np.float64]
WIDTH_MM, CROWN_MM, FRICTION = 21.0, 0.5, 0.8
CURVATURE_MM = (0.5 * WIDTH_MM) ** 2 / CROWN_MM
FORCE_N, LOAD_N = 20.0, 0.5 * 9.81  # a pad's
HANGING = {
    "object__mass_kg": 1.0,
    "object__centre_of_mass_height_mm": 30.0,
    "effects__gravity": "on",
    "gel__crown_mm": CROWN_MM,
    "gel__friction": FRICTION,
    **UPRIGHT,
}
INSERTS = {"circle": 0.167, "rectangle": 0.020, "ellipse": 0.107, "hexagon": 0.186}  # the paper's task, computed


@dataclass(frozen=True, slots=True)
class Compared:
    """One figure beside theory: relative error and its limit."""

    what: str
    error: float
    limit: float


def hang(nodes: int, tier: str, modulus_n_per_mm2: float = 1.0) -> QuasiStaticCell:
    """The hanging box, at rest; its pads are half-spaces of Poisson's ratio 0.5 in the layer tier."""
    grid = {"gel__node_rows": nodes, "gel__node_columns": nodes, "gel__shear_modulus_n_per_mm2": modulus_n_per_mm2}
    cell = QuasiStaticCell(load_scene("rectangle", gel__tier=tier, **grid, **HANGING))
    cell.nodes = bristles.make_nodes(nodes, nodes, WIDTH_MM, WIDTH_MM, CROWN_MM)
    cell.constants["area"] = (WIDTH_MM / nodes) ** 2
    if cell.layer is not None:
        cells = elastic_layer.Grid(nodes, nodes, WIDTH_MM / nodes, WIDTH_MM / nodes)
        cell.layer.use(kernels.half_space(cells, modulus_n_per_mm2, 0.5), cell.nodes, cell.constants)
    cell.regrasp(0.0, 0.0)
    return cell


def relative(computed: Floats, expected: Floats) -> float:
    """Relative error of a field, in the L2 norm."""
    return float(np.linalg.norm(computed - expected) / np.linalg.norm(expected))


def dome(r: Floats, a: float) -> Floats:
    """Hertz's profile, sqrt(1 - (r / a)^2), 0 outside."""
    return np.asarray(np.sqrt(np.clip(1.0 - (r / a) ** 2, 0.0, None)))


def half_space(nodes: int, cell: QuasiStaticCell | None = None) -> list[Compared]:
    """Hertz's pressure, Cattaneo and Mindlin's traction and displacement, nodes x nodes a pad."""
    cell = cell or hang(nodes, "layer")
    shear, share = 1.0, LOAD_N / (FRICTION * FORCE_N)
    a = (3.0 * FORCE_N * CURVATURE_MM / (4.0 * 4.0 * shear)) ** (1.0 / 3.0)  # E* = 2 G / (1 - nu) = 4 G
    top, r = 1.5 * FORCE_N / (math.pi * a * a), np.hypot(cell.nodes["x"], cell.nodes["z"])
    c = a * (1.0 - share) ** (1.0 / 3.0)
    traction = FRICTION * top * (dome(r, a) - c / a * dome(r, c))
    sag = 3.0 * FRICTION * FORCE_N * 1.5 / (16.0 * shear * a) * (1.0 - (1.0 - share) ** (2.0 / 3.0))
    return [
        Compared("pressure, Hertz", relative(cell.nodes["pressure"], top * dome(r, a)), 0.01),
        Compared("tangential displacement, Mindlin", abs(-cell.state["place"][2] / sag - 1.0), 0.001),
        Compared(
            "partial-slip traction, Cattaneo and Mindlin",
            relative(cell.constants["kt"] * np.abs(cell.nodes["sz"]), traction),
            0.03,
        ),
    ]


def winkler(nodes: int, cell: QuasiStaticCell | None = None) -> list[Compared]:
    """A bed of springs (Winkler): pressure, displacement and traction follow from both loads in closed form."""
    cell = cell or hang(nodes, "bristle", modulus_n_per_mm2=0.5)
    kn, kt = float(cell.constants["kn"][0]), float(cell.constants["kt"][0])
    a = (4.0 * FORCE_N * CURVATURE_MM / (math.pi * kn)) ** 0.25
    top, r = kn * a * a / (2.0 * CURVATURE_MM), np.hypot(cell.nodes["x"], cell.nodes["z"])
    sag = FRICTION * top / kt * (1.0 - (1.0 - LOAD_N / (FRICTION * FORCE_N)) ** 0.5)
    traction = np.minimum(kt * sag, FRICTION * top * dome(r, a) ** 2)
    return [
        Compared("pressure, Winkler", relative(cell.nodes["pressure"], top * dome(r, a) ** 2), 0.005),
        Compared("tangential displacement, Winkler", abs(-cell.state["place"][2] / sag - 1.0), 0.002),
        Compared("partial-slip traction, Winkler", relative(kt * np.abs(cell.nodes["sz"]), traction), 0.01),
    ]


def inserting(name: str, draws: int, seed: int) -> Estimate:
    """Share of uniform errors (+-15 mm, +-15 deg) that insert at once."""
    scene, rng = load_scene(name), np.random.default_rng(seed)
    return wilson(sum(scene.fits(x, theta) for x, theta in rng.uniform(-15.0, 15.0, (draws, 2)).tolist()), draws)


def theory_page(grids: tuple[int, ...], draws: int) -> str:
    """The whole of docs/theory.md, recomputed."""
    rows = [row for study in (half_space, winkler) for row in zip(*(study(n) for n in grids), strict=True)]
    shares = [(name, share, inserting(name, draws, 0)) for name, share in INSERTS.items()]
    return page(
        """
        # The simulator beside theory

        Relative errors of the simulated contact against closed forms, through the whole cell: grasp,
        equilibrium and pads.
        """,
        table(
            rows,
            ("quantity", "0.what"),
            *((f"{n} x {n}", f"{place}.error", ".3%") for place, n in enumerate(grids)),
            ("limit at 64 x 64", "0.limit", ".1%"),
        ),
        "Share of uniform errors that insert at once, with the 95 % interval of as many draws.",
        table(shares, ("object", 0), ("computed from the task", 1, ".1%"), (f"drawn, {draws}", 2, ".2%")),
        "Made by `python -m tests.simulation.physics.theory docs`; `make test` holds the limits.",
    )


if __name__ == "__main__":
    publish(Path(sys.argv[1]), "theory", theory_page((32, 64), 20_000))
