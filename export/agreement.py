"""The command of the paper's rule, and how two networks' commands on the same decisions compare."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from export.points import wilson
from service.contract import ModelCard

SAME_MM, SAME_DEG = 0.1, 0.1
GAIN = 0.7
"""A command is -0.7 of the estimate where class and estimate agree."""


@dataclass(frozen=True)
class Agreement:
    """How a twin decides against its source on the same decisions."""

    decisions: int
    same_class: float
    same_commands: int
    sign_flips: int
    apart_p99_mm: float
    apart_p99_deg: float

    @property
    def same_command(self) -> float:
        """Share of decisions whose command stays within 0.1 mm and 0.1 deg."""
        return self.same_commands / self.decisions

    @classmethod
    def of(
        cls,
        classes: tuple[NDArray[np.int64], NDArray[np.int64]],
        commands: tuple[NDArray[np.float64], NDArray[np.float64]],
    ) -> "Agreement":
        """Compare classes [N] and commands [N, 2] in (mm, deg) of the same decisions."""
        apart = np.abs(commands[0] - commands[1])
        same = int(((apart[:, 0] <= SAME_MM) & (apart[:, 1] <= SAME_DEG)).sum())
        flips = int((commands[0] * commands[1] < 0).any(1).sum())
        far_mm, far_deg = (float(value) for value in np.quantile(apart, 0.99, 0))
        return cls(len(apart), float((classes[0] == classes[1]).mean()), same, flips, far_mm, far_deg)

    def __str__(self) -> str:
        """One line, with the interval of the share."""
        share, low, high = wilson(self.same_commands, self.decisions)
        return (
            f"{100 * share:.1f} % [{100 * low:.1f}, {100 * high:.1f}] of {self.decisions} commands within {SAME_MM} mm"
            f" and {SAME_DEG} deg (99 % within {self.apart_p99_mm:.2f} mm, {self.apart_p99_deg:.2f} deg),"
            f" {100 * self.same_class:.1f} % the same class, {self.sign_flips} sign flips"
        )


def density_mean(card: ModelCard, log_density: NDArray[Any]) -> NDArray[np.float64]:
    """Mean error [N, 2] in (mm, deg) of a joint density."""
    weight = np.exp(log_density.astype(np.float64) - log_density.max((1, 2), keepdims=True))
    weight /= weight.sum((1, 2), keepdims=True)
    return np.stack([weight.sum(2) @ np.array(card.grid_x_mm), weight.sum(1) @ np.array(card.grid_theta_deg)], 1)


def paper_rule(card: ModelCard, logits: NDArray[Any], error: NDArray[Any]) -> NDArray[np.float64]:
    """Eq. 1 of the paper: -0.7 d, -0.3 d without a class, -3 S where class and estimate contradict."""
    signs = np.array([(entry.sign_x, entry.sign_theta) for entry in card.classes])[logits.argmax(1)]
    agreeing = signs * error > 0
    stepped = np.where(agreeing, -GAIN * error, -3.0 * signs)
    return np.asarray(np.where(signs == 0, -0.3 * error, stepped), np.float64)
