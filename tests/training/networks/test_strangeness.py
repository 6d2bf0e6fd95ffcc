"""Strangeness: what one object pressed by a block does to two fingers is usual, and what it cannot do is strange."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from service.contract import Sensor
from training.data.faults import SHIFTS, with_faults
from training.data.labels import CLASSES
from training.fit.usual import learn_odds
from training.networks.pressing import LATTICE, PressingNetwork
from training.networks.settings import NetworkConfig
from training.report.depths import auroc


def presses(seed: int, count: int = 600) -> Tensor:
    """Steps [N, 2, 3, rows, columns] of objects that turn and rise in contacts of many sizes, with noise and gaps."""
    rng = np.random.default_rng(seed)
    u, v = np.moveaxis(LATTICE.points_mm, -1, 0)
    radius_mm = rng.uniform(4.0, 12.0, (count, 1, 1))
    contact = 1.0 / (1.0 + np.exp(np.hypot(u, v) - radius_mm))
    turn_rad = rng.choice([-1.0, 1.0], (count, 1, 1)) * np.radians(rng.uniform(0.4, 1.0, (count, 1, 1)))
    lift_mm = rng.uniform(0.02, 0.06, (count, 1, 1))
    fingers = [
        np.stack([-side * turn_rad * v, side * turn_rad * u - lift_mm], 1) * contact[:, None] for side in (1, -1)
    ]
    moved = np.stack(fingers, 1) + rng.normal(0.0, 0.002, (count, 2, 2, *u.shape))
    visible = rng.random((count, 2, 1, *u.shape)) > rng.uniform(0.0, 0.05, (count, 1, 1, 1, 1))
    return torch.tensor(np.concatenate([10.0 * moved * visible, visible], 2), dtype=torch.float32)


@pytest.fixture(scope="module")
def network() -> PressingNetwork:
    torch.manual_seed(0)
    new = PressingNetwork(NetworkConfig(kind="pressing", affine_fit=True), len(CLASSES), Sensor.load()).eval()
    new.trunk.affine.set_spread(presses(0))
    learn_odds(new, presses(0))
    return new


def strangeness(network: PressingNetwork, steps: Tensor) -> np.ndarray:
    with torch.inference_mode():
        return network.strangeness(network.encode(steps))[:, 0].numpy()


def test_what_no_object_does_is_strange(network: PressingNetwork) -> None:
    pressed = presses(1)
    faulty = {name: torch.cat([shift(pressed[:, :, :2]), pressed[:, :, 2:]], 2) for name, shift in SHIFTS.items()}
    told_apart = {name: auroc(strangeness(network, pressed), strangeness(network, one)) for name, one in faulty.items()}
    assert min(told_apart.values()) > 0.95, told_apart


def test_no_motion_at_all_has_a_finite_strangeness(network: PressingNetwork) -> None:
    still = torch.zeros(1, 2, 3, LATTICE.rows, LATTICE.columns)
    assert np.isfinite(strangeness(network, still)).all()


@given(seed=st.integers(0, 2**32 - 1))
def test_each_press_gets_a_fault_that_changes_it(seed: int) -> None:
    pressed = presses(seed % 5, count=20)[:, :, :2]
    assert ((with_faults(pressed, torch.Generator().manual_seed(seed)) - pressed).abs().amax((1, 2, 3, 4)) > 1e-3).all()
