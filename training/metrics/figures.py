"""Quality of the decisions: accuracy, calibration, errors, each with its sample size."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from service.contract import ContractError
from training.data.labels import CLASSES, SIGNS, class_of

Z90 = 1.6448536269514722
BINS = 15
NEAR = len(CLASSES) - 1


@dataclass(frozen=True, slots=True)
class Scales:
    """Calibration fitted on validation trials; see :class:`service.contract.Calibration`."""

    temperature: float = 1.0
    sigma_x: float = 1.0
    sigma_theta: float = 1.0


class Sample(Protocol):
    """A network's raw outputs for some trials, before calibration: a dataclass of arrays over them."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def take(self, chosen: NDArray[np.bool_]) -> Self:
        """The chosen trials."""

    def calibration(self) -> Scales:
        """The scales that fit these trials."""

    def rescaled(self, scales: Scales) -> "Predictions":
        """Calibrated predictions."""


@dataclass(frozen=True, slots=True)
class Predictions:
    """Predictions of N trials: ``logits`` [N, 9], ``error`` and ``log_sigma`` [N, 2], ``truth`` [N, 2] in (mm, deg)."""

    logits: NDArray[np.float64]
    error: NDArray[np.float64]
    log_sigma: NDArray[np.float64]
    truth: NDArray[np.float64]
    objects: NDArray[np.str_]

    def __post_init__(self) -> None:
        """Raise ContractError on a non-finite number, which would spoil every average."""
        for name in ("logits", "error", "log_sigma", "truth"):
            if not np.isfinite(getattr(self, name)).all():
                raise ContractError(f"{name} of some predictions: not finite, their network has diverged")

    @property
    def labels(self) -> NDArray[np.int64]:
        """True class of each trial, [N]."""
        return class_of(self.truth.astype(np.float32))

    @property
    def right(self) -> NDArray[np.bool_]:
        """Whether the likeliest class is the true one, [N]."""
        return np.asarray(self.logits.argmax(1) == self.labels)

    def take(self, chosen: NDArray[np.bool_]) -> Self:
        return replace(self, **{name: getattr(self, name)[chosen] for name in self.__slots__})

    def calibration(self) -> Scales:
        """Temperature of least negative log likelihood; sigma scales whose 90 % interval holds 90 % of further errors.

        That is the error of rank ceil(0.9 (N + 1)), the bound of split conformal prediction (Vovk et al. 2005): the
        plain quantile of 20 errors holds only 86 % of further ones.
        """
        labels = self.labels
        grid = np.exp(np.linspace(np.log(0.3), np.log(5.0), 141))
        losses = [_nll(probabilities(self.logits, t), labels) for t in grid]
        z = np.abs(self.error - self.truth) / np.exp(self.log_sigma)
        rank = min(len(z), math.ceil(0.9 * (len(z) + 1)))
        scale = np.maximum(np.sort(z, axis=0)[rank - 1] / Z90, 1e-3)
        return Scales(float(grid[int(np.argmin(losses))]), float(scale[0]), float(scale[1]))

    def rescaled(self, scales: Scales) -> "Predictions":
        shift = np.log([scales.sigma_x, scales.sigma_theta])
        return replace(self, logits=self.logits / scales.temperature, log_sigma=self.log_sigma + shift)


def probabilities(logits: NDArray[np.float64], temperature: float) -> NDArray[np.float64]:
    normalised: NDArray[np.float64] = softmax(logits / temperature, axis=-1)
    return normalised


Part = TypeVar("Part", bound=Sample)


def joined(parts: Sequence[Part], rows: Sequence[NDArray[np.int64]]) -> Part:
    """All trials of the parts of a sample, in the order of their ``rows`` [n] in the whole."""
    back = np.argsort(np.concatenate(rows))
    names = [field.name for field in fields(parts[0])]
    return replace(parts[0], **{name: np.concatenate([getattr(part, name) for part in parts])[back] for name in names})


def cross_calibrated(sample: Sample, groups: NDArray[np.str_]) -> Predictions:
    """Each half of the groups calibrated on the other half: no trial is scored by a fit that included it."""
    names = np.unique(groups)
    if len(names) < 2:
        return sample.rescaled(sample.calibration())
    half = np.isin(groups, names[::2])
    one, other = sample.take(half), sample.take(~half)
    parts = one.rescaled(other.calibration()), other.rescaled(one.calibration())
    return joined(parts, (np.flatnonzero(half), np.flatnonzero(~half)))


def by_split(samples: Mapping[str, tuple[Sample, NDArray[np.str_]]], scales: Scales) -> dict[str, dict[str, float]]:
    """Figures of every object of each split's sample with its groups; validation is cross-calibrated."""
    rows: dict[str, dict[str, float]] = {}
    for split, (sample, groups) in samples.items():
        fair = cross_calibrated(sample, groups) if split == "validation" else sample.rescaled(scales)
        rows |= {f"{split}/{name}": row for name, row in by_object(fair).items()}
    return rows


def _nll(p: NDArray[np.float64], labels: NDArray[np.int64]) -> float:
    return float(-np.log(np.maximum(p[np.arange(len(labels)), labels], 1e-12)).mean())


def expected_calibration_error(p: NDArray[np.float64], labels: NDArray[np.int64]) -> float:
    """Mean gap between confidence and accuracy of the top class, in equal bins of confidence, weighted by share."""
    confidence = p.max(1)
    right = p.argmax(1) == labels
    index = np.minimum((confidence * BINS).astype(int), BINS - 1)
    count = np.bincount(index, minlength=BINS)
    full, count = count > 0, count[count > 0]
    means, accuracy = (np.bincount(index, values, BINS)[full] / count for values in (confidence, right))
    return float(np.abs(means - accuracy) @ count / count.sum())


def figures(predictions: Predictions) -> dict[str, float]:
    """Every figure of one sample of calibrated predictions; shares in [0, 1], errors in mm and deg."""
    labels = predictions.labels
    p = probabilities(predictions.logits, 1.0)
    chosen = p.argmax(1)
    right = chosen == labels
    outside = labels != NEAR
    residual = predictions.error - predictions.truth
    sigma = np.exp(predictions.log_sigma)
    covered = np.abs(residual) <= Z90 * sigma
    wrong_side = SIGNS[chosen] * SIGNS[labels] < 0
    count = len(labels)
    return {
        "trials": float(count),
        "accuracy": float(right.mean()),
        "accuracy_without_near": float(right[outside].mean()) if outside.any() else 0.0,
        "chance": float(np.bincount(labels).max() / count),
        "nll": _nll(p, labels),
        "ece": expected_calibration_error(p, labels),
        "wrong_side_x": float(wrong_side[:, 0].mean()),
        "wrong_side_theta": float(wrong_side[:, 1].mean()),
        "mae_x_mm": float(np.abs(residual[:, 0]).mean()),
        "mae_theta_deg": float(np.abs(residual[:, 1]).mean()),
        "rmse_x_mm": float(np.sqrt((residual[:, 0] ** 2).mean())),
        "rmse_theta_deg": float(np.sqrt((residual[:, 1] ** 2).mean())),
        "coverage90_x": float(covered[:, 0].mean()),
        "coverage90_theta": float(covered[:, 1].mean()),
    }


def by_object(predictions: Predictions) -> dict[str, dict[str, float]]:
    """Figures of every object, of ``all``, and of all but the circle, whose yaw nothing blocks."""
    names = sorted(set(predictions.objects.tolist()))
    table = {"all": figures(predictions)}
    if "circle" in names and len(names) > 1:
        table["all but circle"] = figures(predictions.take(predictions.objects != "circle"))
    return table | {name: figures(predictions.take(predictions.objects == name)) for name in names}
