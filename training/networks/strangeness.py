"""How unlike a press the motion of two fingers is: one rigid object, pushed up by a block, moves both."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from training.networks.affine import NUMBERS

ALIKE = 6
HIDDEN = 32
FARTHEST = 6.0
"""Numbers farther from their mean, in standard deviations, count as this far."""
LEAST = 1e-3


class Strangeness(nn.Module):
    """Normalised steps [N, 2, 3, rows, columns] and their affine numbers [N, NUMBERS] -> strangeness [N, 1], from 0 up.

    Large ones are the log odds of a faulty camera against a press. Learnt by `training.fit.usual` after the network,
    which does not read it.
    """

    mean: Tensor
    spread: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(NUMBERS + ALIKE))
        self.register_buffer("spread", torch.ones(NUMBERS + ALIKE))
        self.odds = nn.Sequential(
            nn.Linear(NUMBERS + ALIKE, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, 1)
        ).requires_grad_(False)

    def forward(self, affine: Tensor, fields: Tensor) -> Tensor:
        return functional.softplus(self.log_odds(numbers(affine, fields)))

    def log_odds(self, measured: Tensor) -> Tensor:
        """Log odds [N, 1] of a faulty camera, from `numbers`."""
        odds: Tensor = self.odds(((measured - self.mean) / self.spread).clamp(-FARTHEST, FARTHEST))
        return odds


def numbers(affine: Tensor, fields: Tensor) -> Tensor:
    """[N, NUMBERS + ALIKE]: the affine motion, and how well it is that of one object."""
    return torch.cat([affine, alike(fields)], 1)


def alike(fields: Tensor) -> Tensor:
    """[N, 6]: agreement, logarithm of the sizes' ratio, mean and difference of the lifts, roughness of each finger.

    Only points count that both fingers show. The right finger's field is mirrored: it faces the left one.
    """
    both = fields[:, :1, 2:] * fields[:, 1:, 2:].flip(-1)
    right = fields[:, 1:, :2].flip(-1) * torch.tensor([-1.0, 1.0], device=fields.device)[:, None, None]
    moved = torch.cat([fields[:, :1, :2], right], 1) * both
    squares = moved.square().mean((2, 3, 4)) + LEAST**2
    square = squares.mean(1, keepdim=True)
    agreement = (moved[:, 0] * moved[:, 1]).mean((1, 2, 3))[:, None] / square
    ratio = (squares[:, :1] / squares[:, 1:]).log()
    lifts = moved[:, :, 1].mean((2, 3)) / square.sqrt()
    inner = both[..., 1:-1, 1:-1] * (_beside(both) >= 1.0)
    rough = ((moved[..., 1:-1, 1:-1] - _beside(moved)) * inner).square().sum((2, 3, 4)) / (inner.sum((2, 3, 4)) + LEAST)
    roughness = (rough / square + LEAST).log()
    return torch.cat([agreement, ratio, lifts.mean(1, keepdim=True), lifts[:, :1] - lifts[:, 1:], roughness], 1)


def _beside(one: Tensor) -> Tensor:
    """Mean of the four neighbours of each inner point."""
    return 0.25 * (one[..., :-2, 1:-1] + one[..., 2:, 1:-1] + one[..., 1:-1, :-2] + one[..., 1:-1, 2:])
