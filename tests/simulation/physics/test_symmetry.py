"""Mirror and half turn: physics must not know left from right."""

import numpy as np
import pytest

from simulation.data.probe import Probe, run_probe
from simulation.scene.worlds import load_scene
from tests.simulation.scenes import UPRIGHT

CASES = [("rectangle", 7.0, 6.0), ("hexagon", 5.0, -8.0), ("circle", 9.0, 0.0)]


def probe(name: str, x: float, theta: float) -> Probe:
    return run_probe(load_scene(name, **UPRIGHT), x, theta, seed=3)


@pytest.mark.parametrize(("name", "x", "theta"), CASES)
def test_a_half_turn_swaps_the_fingers(name: str, x: float, theta: float) -> None:
    one, other = probe(name, x, theta), probe(name, -x, theta)
    assert one.outcome == other.outcome
    np.testing.assert_allclose(one.gel, other.gel[:, ::-1], atol=2e-3)


@pytest.mark.parametrize(("name", "x", "theta"), CASES)
def test_a_mirror_in_x_flips_columns_and_du(name: str, x: float, theta: float) -> None:
    one, other = probe(name, x, theta), probe(name, -x, -theta)
    mirrored = other.gel[:, :, :, ::-1] * np.array([-1.0, 1.0, 1.0], dtype=np.float16)
    np.testing.assert_allclose(one.gel, mirrored, atol=2e-3)


def test_a_pure_yaw_poke_through_the_centre_turns_nothing() -> None:
    played = probe("rectangle", 0.0, 10.0)
    assert np.abs(played.in_hand[:, 3:]).max() < 1e-6
    assert played.wrench[:, 2].max() == pytest.approx(32.0, abs=0.1)


def test_the_anchor_poke_has_the_anchor_figures() -> None:
    """Rectangle, x = 10 mm, 20 N grip: a few newtons and degrees, slip from the rim after about 1 mm."""
    played = probe("rectangle", 10.0, 0.0)
    at = int(np.argmin(np.abs(played.depth_mm - 6.5)))
    assert played.wrench[at, 2] == pytest.approx(14.0, abs=4.0)
    assert np.degrees(abs(played.in_hand[at, 4])) == pytest.approx(3.4, abs=0.6)
    assert 0.2 < np.abs(played.gel[-1, ..., :2]).max() < 2.0
