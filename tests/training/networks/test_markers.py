"""The network that reads tracked markers: trained without a picture, scored on markers tracked in pictures."""

import numpy as np
import pytest
import torch

from service.contract import Sensor
from tests.training.conftest import MARKERS
from training.data.dataset import load_trials
from training.data.labels import CLASSES
from training.fit.train import train
from training.networks import build
from training.networks.forms import SequenceForm, StepForm


@pytest.mark.slow
def test_it_trains_on_true_fields_and_is_scored_on_tracked_pictures(config, source):
    run = config.model_copy(update={"network": MARKERS})
    checkpoint = train(run, source)
    tracked = load_trials(run.data, source, "markers").drawn
    assert tracked.shape[2:] == (2, 20, 21, 3)
    assert 0.9 < tracked[..., 2].mean() <= 1.0
    assert checkpoint.build().reads_markers
    assert checkpoint.figures["validation/all"]["trials"] == run.data.rendered_validation


def test_tracked_markers_read_as_the_true_field_does(config, source):
    few = {"rendered_training": 0, "rendered_validation": 3, "rendered_test": 0}
    trials = load_trials(config.data.model_copy(update=few), source, "markers")
    network = build(MARKERS, len(CLASSES), Sensor.load())
    chosen = trials.of("validation", rendered=True)
    tracked = network.read_drawn(torch.from_numpy(trials.drawn[trials.picture[chosen]]))
    fields = trials.fields[chosen].astype(np.float32)
    true = network.normalised(torch.from_numpy(np.moveaxis(fields - fields[:, :1], -1, -3).copy()))
    off_mm = (tracked - true)[..., :2, 2:-2, 2:-2].abs()
    assert float(off_mm.mean()) < 0.1 * float(true[..., :2, :, :].abs().max())


def test_a_marker_that_was_not_seen_moves_nothing():
    network = build(MARKERS, len(CLASSES), Sensor.load()).eval()
    first = torch.zeros(1, 2, 20, 21, 3)
    first[..., 2] = 1.0
    then = first.clone()
    then[0, 0, 5, 5] = torch.tensor([90.0, -40.0, 0.0])
    lost = then.clone()
    lost[0, 0, 5, 5, :2] = 0.0
    geometry, state = torch.tensor([[56.0, 30.0]]), torch.zeros(1, MARKERS.state_size)
    states = [network.advance(network.features(frame, first), geometry, state) for frame in (then, lost)]
    assert torch.equal(*states)


def test_both_forms_decide_alike():
    torch.manual_seed(0)
    network = build(MARKERS, len(CLASSES), Sensor.load()).eval()
    frames = torch.rand(1, 8, 2, 20, 21, 3)
    gap, height = torch.full((1, 1), 60.0), torch.full((1, 1), 80.0)
    whole = SequenceForm(network, "direction")(frames, gap, height)[0]
    state = torch.zeros(1, MARKERS.state_size)
    for step in range(8):
        logits, state = StepForm(network, "direction")(frames[:, step], frames[:, 0], state, gap, height)
    assert torch.allclose(whole, logits, atol=1e-6)
