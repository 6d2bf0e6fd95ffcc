"""Posterior of a gel given its probes: estimates with intervals, fitted to simulated cells.

Numbers from probes are mapped to parameters by a ridge regression on random features (Rahimi and Recht 2007), and to
its error by a second one. Intervals are conformal on held-out cells (Lei et al. 2018): for cells drawn likewise, the
stated share contains the truth, however wrong the regression is. A parameter that the numbers do not determine gets its
full range.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.contract import ContractError
from simulation.scene.drawn import PAD_MM2, PITCH_MM, REACH_PITCHES

Floats = NDArray[np.float64]
SHIPPED = Path(__file__).with_name("posterior.npz")
LEVEL = 0.9
FOLDS, AXES, RANDOM, STEEP = 10, 40, 400, 2.0
FAR = 5.0  # deviations from the middle, beyond which a number is clipped
WIDEST = 0.8
"""Share of the span of nine of ten drawn cells: a wider interval adds no knowledge."""
STRANGE = 1.5
"""Limit relative to the strangest fitted cell; see `Posterior.strangeness`."""


REACH = "shear_reach_mm"
"""The client's parameter of the gel; not a key of a world file."""


class Parameter(NamedTuple):
    """One key of a world file's gel, or the shear reach, and its range over drawn cells.

    ``scale``: the scale on which it is uniform.
    """

    key: str
    low: float
    high: float
    scale: str

    def share(self, value: Any) -> Any:
        """Position of values in the range, 0..1, on its scale."""
        low, high = (self._on_scale(end) for end in (self.low, self.high))
        return (self._on_scale(value) - low) / (high - low)

    def value(self, share: float) -> float:
        """The value at a share of the range."""
        low, high = (float(self._on_scale(end)) for end in (self.low, self.high))
        at = low + share * (high - low)
        return math.exp(at) if self.scale == "log" else at * at if self.scale == "root" else at

    def _on_scale(self, value: Any) -> Any:
        return np.log(value) if self.scale == "log" else np.sqrt(value) if self.scale == "root" else np.asarray(value)


PARAMETERS = (
    Parameter("shear_modulus_n_per_mm2", 0.025, 0.4, "log"),
    Parameter("friction", 0.45, 1.0, "log"),
    Parameter("thickness_mm", 1.5, 4.0, "log"),
    Parameter("poisson_ratio", 0.25, 0.495, "even"),
    Parameter("margin_x_mm", 0.0, 8.0, "root"),
    Parameter("margin_z_mm", 0.0, 8.0, "root"),
    Parameter("relaxation_share", 0.0, 0.4, "even"),
    Parameter("relaxation_s", 0.1, 3.0, "log"),
    Parameter(REACH, REACH_PITCHES[0] * PITCH_MM, REACH_PITCHES[1] * PITCH_MM, "log"),
)


def truth_of(tables: Mapping[str, Any]) -> Floats:
    """Shares of a drawn world's tables, in the order of PARAMETERS."""
    gel = dict(tables["gel"])
    gel["margin_x_mm"], gel["margin_z_mm"] = gel["margin_mm"]
    pressure = tables["grasp"]["force_n"] / PAD_MM2
    gel[REACH] = gel["friction"] * pressure * gel["thickness_mm"] / gel["shear_modulus_n_per_mm2"]
    return np.array([float(one.share(gel[one.key])) for one in PARAMETERS])


class Interval(NamedTuple):
    """For one parameter: the estimate, its 90 % interval, and the interval's width over that of drawn cells."""

    key: str
    estimate: float
    low: float
    high: float
    width: float

    @property
    def known(self) -> bool:
        """Whether the probes narrow it down."""
        return self.width < WIDEST


@dataclass(frozen=True)
class Posterior:
    """``about``: how it was made, and the fitted ranges of a cell's stated parameters."""

    middle: Floats
    spread: Floats
    axes: Floats
    estimates: Floats
    errors: Floats
    reach: Floats
    prior: Floats
    about: Mapping[str, Any]

    def shares(self, numbers: Floats) -> tuple[Floats, Floats, Floats]:
        """Estimates and both ends [n, parameters] as shares of the ranges, of numbers [n, p]."""
        features = _expanded(self._scaled(numbers))
        at, off = features @ self.estimates, self.reach * _size(features @ self.errors)
        at, low, high = (np.clip(one, 0.0, 1.0) for one in (at, at - off, at + off))
        return at, low, high

    def strangeness(self, numbers: Floats) -> float:
        """RMS of the whitened numbers: about 1 for a cell like the fitted ones."""
        return float(np.sqrt(np.mean(np.square(self._scaled(numbers) @ self.axes))))

    def intervals(self, numbers: Floats) -> list[Interval]:
        """Intervals of each parameter from one cell's numbers [p]. Raises ContractError if no drawn cell is similar."""
        if not np.isfinite(numbers).all():
            raise ContractError("the probes show too few markers: numbers are missing")
        if (strange := self.strangeness(numbers[None])) > (most := STRANGE * float(self.about["strangest"])):
            raise ContractError(
                f"these presses are like none of the {self.about['cells_n']} simulated cells"
                f" (strangeness {strange:.2f}, at most {most:.2f})"
            )
        rows = zip(PARAMETERS, self.prior, *(one[0] for one in self.shares(numbers[None])), strict=True)
        return [
            Interval(one.key, one.value(at), one.value(low), one.value(high), float((high - low) / wide))
            for one, wide, at, low, high in rows
        ]

    def _scaled(self, numbers: Floats) -> Floats:
        return np.clip((numbers - self.middle) / self.spread, -FAR, FAR)

    def save(self, path: Path) -> None:
        arrays = {name: value.astype(np.float32) for name, value in vars(self).items() if name != "about"}
        np.savez_compressed(path, about=json.dumps(self.about), **arrays)


def load(path: Path = SHIPPED) -> Posterior:
    """The released posterior, or another. Raises ContractError."""
    try:
        with np.load(path) as stored:
            arrays = {name: stored[name].astype(np.float64) for name in stored.files if name != "about"}
            return Posterior(**arrays, about=json.loads(str(stored["about"])))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ContractError(f"{path} holds no posterior: {error}") from error


def fit(numbers: Floats, truth: Floats, tiers: NDArray[np.str_], about: Mapping[str, Any], seed: int = 0) -> Posterior:
    """Fit it to cells: numbers [n, p], truth [n, parameters] as shares, ``tiers`` [n] of the gels.

    Intervals are calibrated separately on each tier, on each cell by a fit without its fold. They are those of the tier
    that needs the widest, because a real gel is of neither.
    """
    middle, spread = np.median(numbers, 0), np.maximum(numbers.std(0), 1e-6)
    scaled = np.clip((numbers - middle) / spread, -FAR, FAR)
    _, sizes, turned = np.linalg.svd(scaled - scaled.mean(0), full_matrices=False)
    axes = turned[:AXES].T / sizes[:AXES] * math.sqrt(len(numbers))
    features = _expanded(scaled)
    folds = np.random.default_rng(seed).permutation(len(numbers)) % FOLDS
    off = _held_out(features, truth, folds)
    size = np.log(np.abs(off) + 0.02)
    ratio = np.abs(off) / _size(size - _held_out(features, size, folds))
    counts = {str(tier): int((tiers == tier).sum()) for tier in np.unique(tiers)}
    ranks = {tier: min(1.0, LEVEL * (1.0 + 1.0 / count)) for tier, count in counts.items()}
    reach = np.max([np.quantile(ratio[tiers == tier], rank, axis=0) for tier, rank in ranks.items()], axis=0)
    prior = np.diff(np.quantile(truth, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL], axis=0), axis=0)[0]
    whitened = np.sqrt(np.square(scaled @ axes).mean(1))
    about = {**about, "cells_n": len(numbers), "tiers": counts, "strangest": float(np.quantile(whitened, 0.999))}
    return Posterior(middle, spread, axes, _ridge(features, truth), _ridge(features, size), reach, prior, about)


def _held_out(features: Floats, wanted: Floats, folds: NDArray[np.int64]) -> Floats:
    """``wanted`` minus the ridge's prediction for each fold from the others."""
    out = np.empty_like(wanted)
    for fold in range(FOLDS):
        held = folds == fold
        out[held] = wanted[held] - features[held] @ _ridge(features[~held], wanted[~held])
    return out


PENALTIES = 10.0 ** np.arange(-1.0, 4.0, 0.5)


def _ridge(features: Floats, wanted: Floats) -> Floats:
    """Weights [features, parameters], each with the best penalty by generalised cross-validation."""
    middle = wanted.mean(0)
    left, sizes, right = np.linalg.svd(features[:, 1:] - features[:, 1:].mean(0), full_matrices=False)
    along = left.T @ (wanted - middle)
    best, weights = np.full(wanted.shape[1], np.inf), np.zeros((features.shape[1] - 1, wanted.shape[1]))
    for penalty in PENALTIES:
        kept = sizes**2 / (sizes**2 + penalty)
        rest = np.square(wanted - middle - left @ (kept[:, None] * along)).sum(0)
        score = rest / (len(wanted) - kept.sum() - 1.0) ** 2
        better = score < best
        best = np.where(better, score, best)
        weights[:, better] = (right.T @ ((kept / sizes)[:, None] * along))[:, better]
    return np.vstack([middle - features[:, 1:].mean(0) @ weights, weights])


def _expanded(scaled: Floats) -> Floats:
    """1, the numbers themselves, and fixed random features of them."""
    rng = np.random.default_rng(0x1D)
    weights = rng.normal(0.0, STEEP / math.sqrt(scaled.shape[1]), (scaled.shape[1], RANDOM))
    hidden = np.tanh(scaled @ weights + rng.uniform(-1.5, 1.5, RANDOM))
    return np.hstack([np.ones((len(scaled), 1)), scaled, hidden])


def _size(logarithm: Floats) -> Floats:
    return np.exp(np.clip(logarithm, math.log(0.02), 0.0))
