"""Usual fields, as in training, to recognise strange ones."""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from service.contract.model_card import Pressing
from training.data.pressed import Pressed
from training.networks.decider import Decider
from training.networks.pressing import PressingNetwork

MOST_USUAL = 5000
FALSE_STOPS = 0.005
"""Share of usual decisions that the strangeness limit refuses."""


def learn_usual(network: Decider, trials: Pressed, steps: Callable[[NDArray[np.int64]], Tensor]) -> Pressing:
    """Fit the network's model of usual fields, and return the card's section on how it reads.

    The limit is exceeded by hardly any validation decision. ``steps``: normalised motion [N, 2, 2, rows, columns] of a
    step of each chosen decision.
    """
    assert isinstance(network, PressingNetwork)
    train = trials.of("train")
    network.strange.learn(steps(train[:: max(1, len(train) // MOST_USUAL)]))
    held = network.strange(steps(trials.of("validation")))
    return trials.pressing(float(torch.quantile(held, 1.0 - FALSE_STOPS)))
