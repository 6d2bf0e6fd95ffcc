"""Load steps that no other solver ends, and what ends them."""

import numpy as np
import pytest
from numpy.typing import NDArray

from simulation.physics.kernels import load_step
from simulation.physics.kernels.bristles import settle
from simulation.physics.layer_pads import LayerPads
from simulation.physics.quasistatic import QuasiStaticCell
from simulation.scene.worlds import load_scene
from tests.simulation.scenes import UPRIGHT

ROUGH = {"blocks__friction": 0.37, "grasp__height_mm": 82.0}


def descend(cell: QuasiStaticCell, depth_mm: float) -> tuple[float, float]:
    """Straight down in parts of 0.5 mm: the worst residual, N, and cone violation, N/mm2."""
    x, y, z, yaw = cell.pose
    worst = np.zeros(2)
    for down in np.arange(0.5, depth_mm + 0.1, 0.5):
        cell.move_to(x, y, z - down, np.degrees(yaw))
        worst = np.maximum(worst, cell.state["report"][[0, 4]])
    return float(worst[0]), float(worst[1])


@pytest.mark.parametrize(("x_mm", "theta_deg"), [(1.5, 2.0), (0.5, 3.0)])
def test_a_high_grip_on_rough_blocks_has_its_equilibrium(x_mm: float, theta_deg: float) -> None:
    """The corner that bears the load runs along the block's edge, 1 / tan(2 deg) times as far as the object moves."""
    cell = QuasiStaticCell(load_scene("rectangle", **ROUGH, **UPRIGHT))
    cell.regrasp(x_mm, theta_deg)
    residual_n, beyond_cone = descend(cell, 9.0)
    assert residual_n <= cell.scene.numerics.residual_n
    assert beyond_cone <= 1e-9


@pytest.mark.parametrize("tier", ["bristle", "layer"])
@pytest.mark.parametrize("seed", [3, 5, 6, 8])
def test_an_object_narrower_than_the_pads_comes_to_rest_askew_between_them(tier: str, seed: int) -> None:
    """Where the pads end beside an upright wall: a node that loses touch there takes its share of the load with it."""
    cell = QuasiStaticCell(load_scene("rectangle", object__size_x_mm=12.0, gel__tier=tier), seed)
    assert cell.regrasp(8.0, 5.0).residual_n <= cell.scene.numerics.residual_n


def test_an_object_that_snaps_over_slowly_is_followed_to_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    cell = QuasiStaticCell(load_scene("rectangle", gel__tier="layer", **UPRIGHT))
    pads = cell.layer
    assert pads is not None

    def unsettled(pads: LayerPads, *_: object) -> int:
        pads.unsettled = True
        return load_step.STALLED

    def approach(patient: bool) -> int:
        rounds = iter(range(10_000))

        def answer(_: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            rest = np.full_like(pads.surface, 0.95 ** next(rounds))
            return rest, rest

        monkeypatch.setattr(pads, "_answer", answer)
        memory = cell.record, cell.slots
        return pads.advance(memory, lambda **_: load_step.SETTLED, patient=patient)

    monkeypatch.setattr(LayerPads, "_settle", unsettled)
    assert approach(patient=False) == load_step.STALLED
    assert approach(patient=True) == load_step.SETTLED


def test_a_wait_of_a_rounding_error_changes_nothing() -> None:
    """As inertia it would be a spring of 1e19 N/mm, in which all other forces drown."""
    cell = QuasiStaticCell(load_scene("mustard", gel__relaxation_share=0.2, effects__inertia="on"))
    assert cell.coasting is not None
    before = cell.regrasp(8.0, 5.0)
    after = cell.wait(2e-13)
    assert after.in_hand == pytest.approx(before.in_hand, abs=1e-6)


@pytest.mark.parametrize(("longest_mm", "lost"), [(0.05, False), (0.0, True)])
def test_an_object_has_left_the_hand_only_where_the_shortest_step_says_so(
    monkeypatch: pytest.MonkeyPatch, longest_mm: float, lost: bool
) -> None:
    """The solver may overshoot in a long step of soft gel: its last guess is far away, the object is not."""
    solve = QuasiStaticCell._pass
    cell, whole = (QuasiStaticCell(load_scene("rectangle", **UPRIGHT)) for _ in range(2))
    for one in (cell, whole):
        one.regrasp(6.0, 0.0)

    def overshoots(self: QuasiStaticCell, target: NDArray[np.float64], dt_s: float | None, blend: float = 1.0) -> int:
        far = self is cell and abs(target[2] - self.pose[2]) > longest_mm
        return load_step.LOST if far else solve(self, target, dt_s, blend)

    monkeypatch.setattr(QuasiStaticCell, "_pass", overshoots)
    for one in (cell, whole):
        descend(one, 9.0)
    assert (cell.grasp_lost, whole.grasp_lost) == (lost, False)
    if not lost:
        assert whole.state["wrench"][2] > 10.0, "it rests on a block"
        np.testing.assert_allclose(cell.state["wrench"], whole.state["wrench"], rtol=0.02, atol=0.2)


def test_forces_that_were_balanced_beyond_the_cone_are_reported_before_they_are_cut() -> None:
    """The return map leaves every stretch inside the cone, so what it cuts off is the evidence."""
    cell = QuasiStaticCell(load_scene("rectangle"))
    cell.regrasp(8.0, 5.0)
    x, y, z, yaw = cell.pose
    cell.move_to(x, y, z - 6.0, np.degrees(yaw))
    nodes = cell.nodes.copy()
    nodes["limit"] *= 2.0  # as if friction had been granted that the pressure does not bear
    nodes["x"] -= 1.0
    assert settle(cell.constants[0], nodes, cell.trials[0])[1] > 1e-3
    drag = float(cell.constants["kt"][0]) * np.hypot(nodes["sx"], nodes["sz"])
    assert np.all(drag <= float(cell.constants["friction"][0]) * nodes["pressure"] + 1e-12)
