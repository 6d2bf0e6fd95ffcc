"""What fields look like in training, so that others are known for strange."""

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
"""Of usual decisions, the share that the limit of strangeness refuses."""


def learn_usual(network: Decider, trials: Pressed, last_steps: Callable[[NDArray[np.int64]], Tensor]) -> Pressing:
    """Teach the network what is usual, and give what its card says of how it reads.

    The limit is what hardly any of validation exceeds. ``last_steps``: normalised motion [N, 2, 2, rows, columns] of
    the last step of chosen decisions.
    """
    assert isinstance(network, PressingNetwork)
    train = trials.of("train")
    network.strange.learn(last_steps(train[:: max(1, len(train) // MOST_USUAL)]))
    held = network.strange(last_steps(trials.of("validation")))
    return trials.pressing(float(torch.quantile(held, 1.0 - FALSE_STOPS)))
