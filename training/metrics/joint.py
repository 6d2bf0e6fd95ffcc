"""Reading a joint density: class, error and spread, and its temperature."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from training.data.labels import CLASSES, class_of
from training.metrics.figures import Predictions, Scales
from training.networks.density import GRID_THETA_DEG, GRID_X_MM

_GRID = np.stack(np.meshgrid(GRID_X_MM, GRID_THETA_DEG, indexing="ij"), -1)
_CELL_CLASS = class_of(_GRID.astype(np.float32))


def normalised(log_density: NDArray[np.float64], temperature: float) -> NDArray[np.float64]:
    """Probability of each cell [N, 41, 40]."""
    probability: NDArray[np.float64] = softmax(log_density / temperature, axis=(1, 2))
    return probability


def density_temperature(log_density: NDArray[np.float64], truth: NDArray[np.float32]) -> float:
    """Temperature at which the true cells are likeliest."""
    row = np.abs(truth[:, :1] - np.array(GRID_X_MM)).argmin(1)
    column = np.abs(truth[:, 1:] - np.array(GRID_THETA_DEG)).argmin(1)
    grid = np.exp(np.linspace(np.log(0.5), np.log(4.0), 43))

    def loss(temperature: float) -> float:
        cells = normalised(log_density, temperature)[np.arange(len(truth)), row, column]
        return float(-np.log(np.maximum(cells, 1e-12)).mean())

    return float(grid[int(np.argmin([loss(temperature) for temperature in grid]))])


@dataclass(frozen=True)
class Densities:
    """Log densities [N, 41, 40] of N trials on the joint grid, the true errors [N, 2] in (mm, deg), and the objects."""

    log_density: NDArray[np.float64]
    truth: NDArray[np.float32]
    objects: NDArray[np.str_]

    def take(self, chosen: NDArray[np.bool_]) -> Self:
        return replace(
            self, log_density=self.log_density[chosen], truth=self.truth[chosen], objects=self.objects[chosen]
        )

    def predictions(self, temperature: float) -> Predictions:
        """Class masses (as logits), mean and spread of each density."""
        p = normalised(self.log_density, temperature)
        mass = np.stack([p[:, index == _CELL_CLASS].sum(1) for index in range(len(CLASSES))], 1)
        mean = np.einsum("nij,ijk->nk", p, _GRID)
        spread = np.einsum("nij,nijk->nk", p, (_GRID - mean[:, None, None]) ** 2)
        logits, log_sigma = np.log(np.maximum(mass, 1e-9)), 0.5 * np.log(np.maximum(spread, 1e-6))
        return Predictions(logits, mean, log_sigma, self.truth.astype(np.float64), self.objects)

    def calibration(self) -> Scales:
        """Temperature of the density, and sigma scales of the predictions read from it."""
        temperature = density_temperature(self.log_density, self.truth)
        return replace(self.predictions(temperature).calibration(), temperature=temperature)

    def rescaled(self, scales: Scales) -> Predictions:
        return self.predictions(scales.temperature).rescaled(replace(scales, temperature=1.0))
