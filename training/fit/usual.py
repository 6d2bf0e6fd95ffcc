"""Usual presses, as in training, to recognise strange ones: a small network tells them from presses with a fault."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from service.contract.model_card import Pressing
from training.data.faults import with_faults
from training.data.pressed import Pressed
from training.networks.affine import AffineFit
from training.networks.decider import Decider
from training.networks.pressing import PressingNetwork
from training.networks.strangeness import LEAST, numbers

MOST_USUAL = 20_000
FALSE_STOPS = 0.003
"""Share of usual decisions that the strangeness limit refuses."""
FAULTS, FITTED, BATCH, RATE = 6, 12_000, 256, 3e-3
"""Faults of each press, and the fit's steps, batch and learning rate."""
BLUR = 0.1
"""Noise on the numbers in the fit, in standard deviations: gels elsewhere move a little differently."""


def learn_usual(network: Decider, trials: Pressed, steps: Callable[..., Tensor]) -> Pressing:
    """Fit the network's model of usual fields, and return the card's section on how it reads.

    The limit is exceeded by hardly any validation decision. ``steps``: normalised steps [N, 2, 3, rows, columns] of the
    chosen decisions, through cameras as in training with a generator.
    """
    assert isinstance(network, PressingNetwork)
    train = trials.of("train")
    learn_odds(network, steps(train[:: max(1, len(train) // MOST_USUAL)], np.random.default_rng(0)))
    with torch.no_grad():
        held = network.strangeness(network.encode(steps(trials.of("validation"), np.random.default_rng(1))))
    return trials.pressing(float(torch.quantile(held, 1.0 - FALSE_STOPS)))


def learn_odds(network: PressingNetwork, fields: Tensor) -> None:
    """Learn the odds of a fault by outlier exposure (Hendrycks et al., 2019): usual presses against faulty ones."""
    strange, rng = network.strange, torch.Generator().manual_seed(0)
    with torch.no_grad():
        usual = _numbers(network, fields)
        strange.mean.copy_(usual.mean(0))
        strange.spread.copy_(usual.std(0, correction=0).clamp_min(LEAST))
        drawn = [with_faults(fields[:, :, :2], rng) for _ in range(FAULTS)]
        faulty = torch.cat([_numbers(network, torch.cat([moved, fields[:, :, 2:]], 2)) for moved in drawn])
    weights = list(strange.odds.requires_grad_(True).parameters())
    optimiser = torch.optim.AdamW(weights, RATE)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, FITTED)
    with torch.enable_grad():
        for _ in range(FITTED):
            odds, fault_odds = (strange.log_odds(_some(each, strange.spread, rng)) for each in (usual, faulty))
            loss = functional.softplus(odds).mean() + functional.softplus(-fault_odds).mean()
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            falling.step()
    strange.odds.requires_grad_(False)


def _some(numbers_of: Tensor, spread: Tensor, rng: torch.Generator) -> Tensor:
    """A batch of rows, blurred."""
    chosen = numbers_of[torch.randint(len(numbers_of), (BATCH,), generator=rng)]
    return chosen + BLUR * spread * torch.randn(chosen.shape, generator=rng)


def _numbers(network: PressingNetwork, fields: Tensor) -> Tensor:
    affine = network.trunk.affine
    assert isinstance(affine, AffineFit)
    return numbers(affine.raw(fields) / affine.spread, fields)
