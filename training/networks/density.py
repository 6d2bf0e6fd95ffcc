"""A joint density over the position error: a mixture of Gaussians, evaluated on a grid inside the graph.

Unlike one Gaussian, a mixture can be undecided between left and right; few parameters keep it smooth on few data.
"""

import math

import torch
from torch import Tensor, nn

COMPONENTS = 8
UNIT = 5.0
"""Means and spreads are learnt in units of 5 mm and 5 deg."""
NARROWEST, WIDEST = math.log(0.04), math.log(3.0)

# Cells of 1 mm and 1 deg with borders on the class thresholds (2.5 mm, 5 deg).
GRID_X_MM = tuple(float(x) for x in range(-20, 21))
GRID_THETA_DEG = tuple(theta + 0.5 for theta in range(-20, 20))


class MixtureDensity(nn.Module):
    """State [B, S] -> mixture over (x, theta): log weights [B, K], means [B, K, 2], log spreads [B, K, 2]."""

    grid_x: Tensor
    grid_theta: Tensor

    def __init__(self, state_size: int) -> None:
        super().__init__()
        self.parts = nn.Linear(state_size, COMPONENTS * 5)
        with torch.no_grad():  # components start spread over the plane, so that all of them are used
            start = torch.randn(COMPONENTS, 2, generator=torch.Generator().manual_seed(0))
            self.parts.bias.view(COMPONENTS, 5)[:, 1:3] = 1.5 * start
        self.register_buffer("grid_x", torch.tensor(GRID_X_MM) / UNIT, persistent=False)
        self.register_buffer("grid_theta", torch.tensor(GRID_THETA_DEG) / UNIT, persistent=False)

    def forward(self, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The mixture, in units of 5 mm and 5 deg."""
        parts = self.parts(state).reshape(-1, COMPONENTS, 5)
        middle, half = (WIDEST + NARROWEST) / 2, (WIDEST - NARROWEST) / 2
        return torch.log_softmax(parts[..., 0], 1), parts[..., 1:3], middle + half * torch.tanh(parts[..., 3:] / half)

    def negative_log_likelihood(self, state: Tensor, error: Tensor) -> Tensor:
        """[B], of errors [B, 2] in (mm, deg), per (5 mm, 5 deg)."""
        log_weight, mean, log_spread = self(state)
        z = (error[:, None] / UNIT - mean) * torch.exp(-log_spread)
        log_parts = -0.5 * z.square() - log_spread - 0.5 * math.log(2 * math.pi)
        return -torch.logsumexp(log_weight + log_parts.sum(-1), 1)

    def on_grid(self, state: Tensor) -> Tensor:
        """Log density [B, len(GRID_X_MM), len(GRID_THETA_DEG)]."""
        log_weight, mean, log_spread = self(state)
        inverse = torch.exp(-log_spread)
        along_x = -0.5 * ((self.grid_x - mean[..., :1]) * inverse[..., :1]).square() - log_spread[..., :1]
        along_theta = -0.5 * ((self.grid_theta - mean[..., 1:]) * inverse[..., 1:]).square() - log_spread[..., 1:]
        parts = log_weight[..., None, None] + along_x[..., :, None] + along_theta[..., None, :]
        return torch.logsumexp(parts, 1)
