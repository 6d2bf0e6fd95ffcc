"""Objections to replacing the release by a stage, both on the same held-out fixtures."""

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from reporting.statistics import clustered
from training.adapt.stages import StageName
from training.metrics.figures import Z90, Predictions, probabilities

DRAWS = 2000
BY_CHANCE = 0.05
"""Largest probability, all stages together, that a gain is chance."""
FAVOURED_FROM, FAVOURED_SHARE = 100, 0.8
"""Probes from which `all` gets this share of that probability: the other stages seldom win there."""
COVERAGE_SLACK = 0.02


def chances(stages: tuple[StageName, ...], probes_n: int) -> dict[StageName, float]:
    """Each stage's part of `BY_CHANCE`, because one stage of several is chosen (weighted Bonferroni)."""
    others = len(stages) - ("all" in stages)
    if not others or "all" not in stages or probes_n < FAVOURED_FROM:
        return dict.fromkeys(stages, BY_CHANCE / max(1, len(stages)))
    left = (1.0 - FAVOURED_SHARE) / others
    return {stage: BY_CHANCE * (FAVOURED_SHARE if stage == "all" else left) for stage in stages}


def losses(predictions: Predictions) -> NDArray[np.float64]:
    """[N]: negative log likelihood of class and error."""
    labels = predictions.labels
    p = probabilities(predictions.logits, 1.0)[np.arange(len(labels)), labels]
    z = (predictions.error - predictions.truth) / np.exp(predictions.log_sigma)
    return np.asarray(-np.log(np.maximum(p, 1e-12)) + (0.5 * z**2 + predictions.log_sigma).mean(1), np.float64)


def to_gain(
    before: Predictions, after: Predictions, groups: NDArray[np.str_], seed: int, chance: float
) -> Iterable[str]:
    """Objections to a network that claims a gain: in pairs over fixtures, each count by its mean."""
    fixtures = np.unique(groups, return_inverse=True)[1]
    counts: dict[str, Callable[[Predictions], NDArray[np.float64]]] = {
        "direction": lambda one: (~one.right).astype(np.float64),
        "error in x": lambda one: np.abs(one.error - one.truth)[:, 0],
        "error in yaw": lambda one: np.abs(one.error - one.truth)[:, 1],
    }
    gain = losses(before) - losses(after)
    gained = _means(gain, fixtures, seed)
    if (least := min(float(np.quantile(gained, chance)), _least(gain, fixtures, chance))) <= 0.0:
        yield f"likelier by {gained.mean():.3f}, which may be chance ({chance:.2%} quantile {least:.3f})"
    for name, count in counts.items():
        lost = float((count(after) - count(before)).mean())
        if lost > 0.0:
            yield f"{name} is worse by {lost:.3f}"
    for was, now, name in zip(_coverage(before), _coverage(after), ("x", "yaw"), strict=True):
        if abs(now - 0.9) > abs(was - 0.9) + COVERAGE_SLACK:
            yield f"the 90 % interval of {name} holds {now:.0%} of errors, {was:.0%} before"


def to_wider(before: Predictions, groups: NDArray[np.str_]) -> Iterable[str]:
    """Objections to making a network less sure, no more: in x or yaw its 90 % intervals have to hold less than 90 %.

    That is proven where the interval of the share that they hold, with attempts of a fixture alike, ends below it.
    """
    fixtures = np.unique(groups, return_inverse=True)[1]
    counts = np.bincount(fixtures).tolist()
    held = [clustered(np.bincount(fixtures, held).tolist(), counts) for held in _in_intervals(before).T]
    if all(share.high >= 0.9 for share in held):
        in_x, in_yaw = (f"{share:.0%}" for share in held)
        yield f"its 90 % intervals hold {in_x} of errors in x and {in_yaw} in yaw, which may be chance"


def _in_intervals(predictions: Predictions) -> NDArray[np.bool_]:
    """[N, 2]: which errors the 90 % intervals hold, in x and in yaw."""
    off = np.abs(predictions.error - predictions.truth)
    return np.asarray(off <= Z90 * np.exp(predictions.log_sigma))


def _coverage(predictions: Predictions) -> NDArray[np.float64]:
    """Share of errors in the 90 % intervals, in x and in yaw."""
    return np.asarray(_in_intervals(predictions).mean(0), np.float64)


def _means(values: NDArray[np.float64], fixtures: NDArray[np.int64], seed: int) -> NDArray[np.float64]:
    """Means of bootstrap draws of whole fixtures [DRAWS]."""
    count = np.bincount(fixtures)
    total = np.bincount(fixtures, values)
    drawn = np.random.default_rng(seed).integers(0, len(count), (DRAWS, len(count)))
    return np.asarray(total[drawn].sum(1) / count[drawn].sum(1), np.float64)


def _least(values: NDArray[np.float64], fixtures: NDArray[np.int64], chance: float) -> float:
    """A mean that is not reached by that chance: Student's t over fixtures, as a bootstrap of few errs too often."""
    count = np.bincount(fixtures)
    off = np.bincount(fixtures, values - values.mean())  # of a fixture in all
    error = np.sqrt(np.square(off).sum() * len(count) / (len(count) - 1)) / len(values)
    return float(values.mean() + stdtrit(len(count) - 1, chance) * error)
