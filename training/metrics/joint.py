"""Reading a joint density: what it says of the class, the error and the spread, and how sharp it should be."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from training.data.labels import CLASSES, class_of
from training.metrics.figures import Predictions, Scales, calibrate, first_half, interleaved, rescaled
from training.networks.density import GRID_THETA_DEG, GRID_X_MM

_GRID = np.stack(np.meshgrid(GRID_X_MM, GRID_THETA_DEG, indexing="ij"), -1)
_CELL_CLASS = class_of(_GRID.astype(np.float32))


def normalised(log_density: NDArray[np.float64], temperature: float) -> NDArray[np.float64]:
    """Probability of each cell [N, 41, 40]."""
    scaled = log_density / temperature
    weights = np.exp(scaled - scaled.max((1, 2), keepdims=True))
    probability: NDArray[np.float64] = weights / weights.sum((1, 2), keepdims=True)
    return probability


def density_temperature(log_density: NDArray[np.float64], truth: NDArray[np.float32]) -> float:
    """Temperature under which the true cells are likeliest."""
    row = np.abs(truth[:, :1] - np.array(GRID_X_MM)).argmin(1)
    column = np.abs(truth[:, 1:] - np.array(GRID_THETA_DEG)).argmin(1)
    grid = np.exp(np.linspace(np.log(0.5), np.log(4.0), 43))

    def loss(temperature: float) -> float:
        cells = normalised(log_density, temperature)[np.arange(len(truth)), row, column]
        return float(-np.log(np.maximum(cells, 1e-12)).mean())

    return float(grid[int(np.argmin([loss(temperature) for temperature in grid]))])


def from_density(
    log_density: NDArray[np.float64], temperature: float, truth: NDArray[np.float32], objects: NDArray[np.str_]
) -> Predictions:
    """Class masses (as logits), mean and spread of each density."""
    p = normalised(log_density, temperature)
    mass = np.stack([p[:, index == _CELL_CLASS].sum(1) for index in range(len(CLASSES))], 1)
    mean = np.einsum("nij,ijk->nk", p, _GRID)
    spread = np.einsum("nij,nijk->nk", p, (_GRID - mean[:, None, None]) ** 2)
    return Predictions(
        np.log(np.maximum(mass, 1e-9)), mean, 0.5 * np.log(np.maximum(spread, 1e-6)), truth.astype(np.float64), objects
    )


def calibrate_density(
    log_density: NDArray[np.float64], truth: NDArray[np.float32], objects: NDArray[np.str_]
) -> Scales:
    """Temperature of the density, and sigma scales of what is then read from it."""
    temperature = density_temperature(log_density, truth)
    return replace(calibrate(from_density(log_density, temperature, truth, objects)), temperature=temperature)


def calibrated_density(
    log_density: NDArray[np.float64], truth: NDArray[np.float32], objects: NDArray[np.str_], scales: Scales
) -> Predictions:
    """What densities say with their calibration applied."""
    said = from_density(log_density, scales.temperature, truth, objects)
    return rescaled(said, replace(scales, temperature=1.0))


def cross_calibrated_density(
    log_density: NDArray[np.float64],
    truth: NDArray[np.float32],
    objects: NDArray[np.str_],
    groups: NDArray[np.str_],
) -> Predictions:
    """Each half of the groups calibrated on the other half: no trial is scored by a fit that saw it."""
    half = first_half(groups)
    if half is None:
        return calibrated_density(log_density, truth, objects, calibrate_density(log_density, truth, objects))

    def read(scored: NDArray[np.bool_]) -> Predictions:
        fitted = calibrate_density(log_density[~scored], truth[~scored], objects[~scored])
        return calibrated_density(log_density[scored], truth[scored], objects[scored], fitted)

    return interleaved(read(half), read(~half), half)
