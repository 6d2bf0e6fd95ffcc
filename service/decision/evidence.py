"""From the frames of one attempt to the evidence on the position error."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from service.contract import ContractError, ErrorClass, ModelCard
from service.contract.wire import Estimate, NoDecisionReason
from service.decision.models import Array, ModelSet

Floats = NDArray[np.float64]
Z_90 = 1.6448536269514722  # a normal variable lies within this many sigmas with probability 0.9


class Refusal(ContractError):  # noqa: N818 - a refusal is an answer, not an error
    """No correction can be trusted; ``reason`` is the wire's code."""

    def __init__(self, reason: NoDecisionReason, detail: str) -> None:
        super().__init__(detail)
        self.reason: NoDecisionReason = reason


def paused() -> Refusal:
    """Of a press in which the arm paused, or touched as it did."""
    return Refusal("stale", "the arm paused in the press: how deep it was in each picture is not known")


@dataclass(frozen=True, slots=True)
class Density:
    """A log density over the error: ``log_density`` [nx, ntheta] on the grid of a joint network, unnormalised."""

    x_mm: Floats
    theta_deg: Floats
    log_density: Floats


@dataclass(frozen=True, slots=True)
class Evidence:
    """The result of one attempt: class probabilities, estimated error (mm, deg) and sigma (mm, deg; None if not given).

    Raises Refusal where any of these is not finite: such numbers are no evidence.
    """

    classes: tuple[ErrorClass, ...]
    probabilities: Floats
    error: tuple[float, float]
    sigma: tuple[float, float] | None = None
    density: Density | None = None
    threshold_x_mm: float = 2.5
    threshold_theta_deg: float = 5.0

    def __post_init__(self) -> None:
        """Refuse non-finite values, before any controller sees them."""
        numbers = [*np.ravel(self.probabilities), *self.error, *(self.sigma or ())]
        density = () if self.density is None else self.density.log_density
        if not (np.isfinite(numbers).all() and np.isfinite(density).all()):
            raise Refusal("non_finite", f"estimated error {self.error}, sigma {self.sigma}: expected finite evidence")

    @property
    def best(self) -> ErrorClass:
        return self.classes[int(np.argmax(self.probabilities))]

    @property
    def confidence(self) -> float:
        """Probability of the most probable class."""
        return float(np.max(self.probabilities))

    def class_probabilities(self) -> dict[str, float]:
        return {entry.name: float(p) for entry, p in zip(self.classes, self.probabilities, strict=True)}

    def estimate(self) -> Estimate:
        """The error before the correction with one sigma and the 90 % interval, in its wire form."""
        dx_mm, dtheta_deg = self.error
        if self.sigma is None:
            return Estimate(dx_mm=dx_mm, dtheta_deg=dtheta_deg)
        half_x, half_theta = Z_90 * self.sigma[0], Z_90 * self.sigma[1]
        return Estimate(
            dx_mm=dx_mm,
            dtheta_deg=dtheta_deg,
            sigma_x_mm=self.sigma[0],
            sigma_theta_deg=self.sigma[1],
            interval_x_mm=(dx_mm - half_x, dx_mm + half_x),
            interval_theta_deg=(dtheta_deg - half_theta, dtheta_deg + half_theta),
        )


class DecisionRun:
    """The networks over one attempt, fed pair by pair on arrival, so that one step remains after the last frame.

    ``reference`` and every frame are [2, *card.input_shape], left finger first: pictures, marker fields or steps of
    depth; ``conditions`` belong to the latter. Not thread safe: one thread feeds a run.
    """

    def __init__(
        self,
        models: ModelSet,
        reference: NDArray[np.uint8] | NDArray[np.float32],
        gap_width_mm: float,
        grasp_height_mm: float | None = None,
        conditions: Mapping[str, float | None] = MappingProxyType({}),
    ) -> None:
        self._models = models
        self._reference = reference
        self._geometry = gap_width_mm, grasp_height_mm, conditions
        self._states = [step.fresh_state() for step in models.steps]
        self._outputs: list[dict[str, Array]] = []
        self.frames_n = 0
        self.step_ms = 0.0

    def step(self, frame: NDArray[np.uint8] | NDArray[np.float32]) -> None:
        """Advance every network by one pair; raise ContractError on a frame of the wrong shape."""
        self._models.card.check(frame)
        started = time.perf_counter()
        pairs = zip(self._models.steps, self._states, strict=True)
        advanced = [step.step(frame, self._reference, state, *self._geometry) for step, state in pairs]
        self._outputs, self._states = [outputs for outputs, _ in advanced], [state for _, state in advanced]
        self.step_ms = (time.perf_counter() - started) * 1e3
        self.frames_n += 1

    def _check_count(self) -> None:
        card = self._models.card
        needed = card.pressing.least_steps_n if card.pressing else card.frames_per_decision
        if self.frames_n < needed:
            what = "steps of depth" if card.pressing else "frame pairs"
            raise Refusal("too_few_frames", f"{self.frames_n} {what} since motion began, expected {needed}")

    def evidence(self) -> Evidence:
        """The evidence after the last frame; raise Refusal on too few frames or a non-finite output."""
        self._check_count()
        by_role = {step.card.role: out for step, out in zip(self._models.steps, self._outputs, strict=True)}
        for role, outputs in by_role.items():
            if not all(np.isfinite(value).all() for value in outputs.values()):
                raise Refusal("non_finite", f"the {role} network gave a non-finite output")
        cards = {step.card.role: step.card for step in self._models.steps}
        for role, outputs in by_role.items():
            check_strangeness(cards[role], outputs)
        if "joint" in by_role:
            return from_joint(cards["joint"], by_role["joint"])
        if "pair" in by_role:
            return from_pair(cards["pair"], cards["pair"], by_role["pair"], by_role["pair"])
        return from_pair(cards["direction"], cards["magnitude"], by_role["direction"], by_role["magnitude"])


def check_strangeness(card: ModelCard, outputs: dict[str, Array]) -> None:
    """Raise Refusal if the network finds its input stranger than its card allows."""
    limit = card.pressing.strangeness_limit if card.pressing else None
    if limit is not None and not float(outputs["strangeness"][0, 0]) <= limit:
        strangeness = float(outputs["strangeness"][0, 0])
        detail = (
            "the gels do not move as one pressed object moves them: is a camera mirrored, turned, frozen or wrongly"
            f" scaled? (strangeness {strangeness:.1f}, at most {limit:.1f})"
        )
        raise Refusal("out_of_distribution", detail)


def softmax(logits: Floats) -> Floats:
    """Probabilities over the last axis; raises Refusal on logits that are not finite."""
    if not np.isfinite(logits).all():
        raise Refusal("non_finite", f"logits of {logits.ravel()[:4].tolist()}..., expected finite numbers")
    weights = np.exp(logits - logits.max(axis=-1, keepdims=True))
    return np.asarray(weights / weights.sum(axis=-1, keepdims=True), np.float64)


def from_pair(
    direction: ModelCard, magnitude: ModelCard, logits: dict[str, Array], moments: dict[str, Array]
) -> Evidence:
    """Evidence of a direction and a magnitude network, with each card's calibration applied."""
    probabilities = softmax(np.asarray(logits["logits"][0], np.float64) / direction.calibration.temperature)
    dx_mm, dtheta_deg = (float(value) for value in moments["error"][0])
    if not np.isfinite([dx_mm, dtheta_deg]).all():
        raise Refusal("non_finite", f"the magnitude network gave an error of ({dx_mm} mm, {dtheta_deg} deg)")
    sigma = None
    if magnitude.has_sigma:
        with np.errstate(over="ignore"):  # refused below
            raw_x, raw_theta = np.exp(np.asarray(moments["log_sigma"][0], np.float64))
        scale = magnitude.calibration
        sigma = (float(raw_x * scale.sigma_scale_x), float(raw_theta * scale.sigma_scale_theta))
        if not np.isfinite(sigma).all() or min(sigma) <= 0:
            raise Refusal("non_finite", f"the magnitude network gave a sigma of {sigma}")
    return Evidence(
        direction.classes,
        probabilities,
        (dx_mm, dtheta_deg),
        sigma,
        threshold_x_mm=direction.threshold_x_mm,
        threshold_theta_deg=direction.threshold_theta_deg,
    )


def from_joint(card: ModelCard, outputs: dict[str, Array]) -> Evidence:
    """Evidence of a joint network: classes, mean and sigma follow from its density."""
    x_mm, theta_deg = np.array(card.grid_x_mm), np.array(card.grid_theta_deg)
    log_density = np.asarray(outputs["log_density"][0], np.float64) / card.calibration.temperature
    if not np.isfinite(log_density).all():
        raise Refusal("non_finite", "the joint network gave a density that is not finite")
    weights = np.exp(log_density - log_density.max())
    weights /= weights.sum()
    mean_x, mean_theta = float(weights.sum(1) @ x_mm), float(weights.sum(0) @ theta_deg)
    sigma_x = float(np.sqrt(weights.sum(1) @ (x_mm - mean_x) ** 2)) * card.calibration.sigma_scale_x
    sigma_theta = float(np.sqrt(weights.sum(0) @ (theta_deg - mean_theta) ** 2)) * card.calibration.sigma_scale_theta
    sign_x = np.sign(x_mm) * (np.abs(x_mm) > card.threshold_x_mm)
    sign_theta = np.sign(theta_deg) * (np.abs(theta_deg) > card.threshold_theta_deg)
    probabilities = np.array(
        [weights[np.ix_(sign_x == entry.sign_x, sign_theta == entry.sign_theta)].sum() for entry in card.classes]
    )
    return Evidence(
        card.classes,
        probabilities / max(probabilities.sum(), 1e-12),
        (mean_x, mean_theta),
        (max(sigma_x, 1e-3), max(sigma_theta, 1e-3)),
        Density(x_mm, theta_deg, log_density),
        card.threshold_x_mm,
        card.threshold_theta_deg,
    )
