"""A step's handling of its state, which comes from outside the graph and may be any float."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from service.contract import Sensor
from tests.training.conftest import MARKERS
from training.data.labels import CLASSES
from training.networks import build
from training.networks.alexnet import LSTM, AlexNetLstm
from training.networks.decider import STATE_REACH
from training.networks.forms import StepForm, within_reach

END = float(np.float32(STATE_REACH))
reached = st.floats(-END, END, width=32)


@given(st.lists(reached, min_size=1, max_size=8))
def test_a_state_within_reach_stays_what_it_is_bit_for_bit(values):
    state = torch.tensor([[*values, -0.0, 1e-45]])
    same = within_reach(state, STATE_REACH).numpy().view(np.int32)
    np.testing.assert_array_equal(same, state.numpy().view(np.int32))


@given(st.floats(END, 2.0**127, width=32), st.booleans())
def test_a_state_beyond_reach_is_brought_back_to_its_end(value, negative):
    sign = -1.0 if negative else 1.0
    back = within_reach(torch.tensor([[sign * value]]), STATE_REACH)
    assert float(back) == pytest.approx(sign * STATE_REACH, rel=1e-6)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_a_state_that_is_no_number_stays_none(value):
    assert within_reach(torch.tensor([[value]]), STATE_REACH).isnan().all()


def test_no_gated_cell_of_ours_leaves_its_reach():
    torch.manual_seed(0)
    network = build(MARKERS, len(CLASSES), Sensor.load()).eval()
    state = torch.empty(64, 16).uniform_(-1.0, 1.0)
    state[:2] = torch.tensor([[1.0], [-1.0]])
    geometry = torch.tensor([[56.0, 30.0]]).expand(64, 2)
    with torch.no_grad():
        for _ in range(200):
            state = network.advance(1e3 * torch.randn(64, 32), geometry, state)
            assert state.abs().max() <= STATE_REACH


def test_no_hidden_unit_of_the_papers_cell_leaves_its_reach():
    torch.manual_seed(0)
    network = AlexNetLstm(2)
    state = torch.zeros(4, network.state_size)
    with torch.no_grad():
        for steps in range(1, 50):
            state = network.advance(10.0 * torch.randn(4, 2 * 4096), None, state)
            assert state[:, :LSTM].abs().max() <= network.state_reach[0]
            assert state[:, LSTM:].abs().max() <= steps


def test_a_step_from_a_state_no_cell_can_reach_equals_one_from_the_end_of_its_reach():
    torch.manual_seed(0)
    step = StepForm(build(MARKERS, len(CLASSES), Sensor.load()).eval(), "joint")
    frame, reference = torch.rand(2, 1, 2, 20, 21, 3)
    gap, height, signs = torch.full((1, 1), 56.0), torch.full((1, 1), 30.0), torch.randn(1, 16).sign()
    far, near = (step(frame, reference, signs * reach, gap, height) for reach in (1e4, STATE_REACH))
    for one, other in zip(far, near, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5)
    assert all(output.isnan().any() for output in step(frame, reference, signs * torch.inf, gap, height))
