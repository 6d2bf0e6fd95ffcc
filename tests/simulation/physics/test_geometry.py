"""The geometry table of the paper: inserting poses, allowed errors, and the lever arm about the block's edge."""

import numpy as np
import pytest

from simulation.data.probe import QuasiStaticCell
from simulation.scene.shapes import half_width_mm
from simulation.scene.worlds import load_scene
from tests.simulation.physics.theory import INSERTS, inserting, theory_page
from tests.simulation.scenes import UPRIGHT


@pytest.mark.parametrize(
    ("name", "share", "limits"),
    [
        ("circle", 0.167, (2.5, 2.5, 2.5, 2.5)),
        ("rectangle", 0.020, (2.5, None, None, None)),
        ("ellipse", 0.107, (2.5, 2.2, 1.3, None)),
        ("hexagon", 0.186, (2.5, 2.6, 2.9, 3.4)),
    ],
)
def test_the_geometry_table_holds(name: str, share: float, limits: tuple[float | None, ...]) -> None:
    scene = load_scene(name)
    room = [0.5 * scene.blocks.gap_mm - half_width_mm(scene.object.footprint_mm, t) for t in (0, 5, 10, 15)]
    for room_mm, expected in zip(room, limits, strict=True):
        assert room_mm < 0 if expected is None else room_mm == pytest.approx(expected, abs=0.06)
    grid = np.linspace(-15, 15, 401)
    wide = np.array([half_width_mm(scene.object.footprint_mm, t) for t in grid])
    inserts = np.clip(0.5 * scene.blocks.gap_mm - wide, 0, 15) / 15
    assert inserts.mean() == pytest.approx(share, abs=0.002)


@pytest.mark.parametrize("name", INSERTS)
def test_as_many_random_errors_insert_as_the_table_says(name: str) -> None:
    """Within three standard errors of the draw, and the table's own rounding."""
    share = inserting(name, 4000, seed=3).value
    error = (share * (1.0 - share) / 4000) ** 0.5
    assert abs(share - INSERTS[name]) < 3.0 * error + 0.0005


def test_the_page_beside_theory_is_written() -> None:
    page = theory_page((8,), 50)
    assert "| pressure, Hertz |" in page
    assert "| hexagon | 18.6 % |" in page


@pytest.mark.parametrize("x", [4.0, 10.0, -7.0])
def test_the_lever_arm_is_half_the_gap_less_the_offset(x: float) -> None:
    scene = load_scene("rectangle", blocks__friction=0.0, effects__gravity="off", **UPRIGHT)
    cell = QuasiStaticCell(scene)
    cell.regrasp(x, 0.0)
    state = cell.move_to(x, 0.0, 30.0 - 0.3, 0.0)
    along, force, moment = state.wrench_n_nmm[0], state.wrench_n_nmm[2], state.wrench_n_nmm[4]
    assert force > 1.0
    # the edge force acts along the slightly turned bottom's normal, 29.7 mm below the TCP: take its moment out
    lever = (moment + 29.7 * along) / force
    assert lever == pytest.approx(-np.sign(x) * (28.0 - abs(x)), abs=1e-3)


def test_a_descent_inserts_exactly_when_geometry_says_so() -> None:
    rng = np.random.default_rng(5)
    for name in ("circle", "rectangle", "ellipse", "hexagon"):
        scene = load_scene(name, **UPRIGHT)
        cell = QuasiStaticCell(scene)
        for _ in range(6):
            x, theta = rng.uniform(-4, 4), rng.uniform(-5, 5)
            if abs(abs(x) + half_width_mm(scene.object.footprint_mm, theta) - 28.0) < 0.02:
                continue
            cell.regrasp(x, theta)
            state = cell.move_to(cell.pose[0], 0.0, cell.pose[2] - 5.6, theta)
            assert state.in_contact != scene.fits(x, theta)
