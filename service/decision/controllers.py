"""From evidence to the next move: the paper's heuristic (Eq. 1), and a belief that remembers attempts."""

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from service.contract.model_card import Expectations
from service.contract.wire import ControllerName, Limits
from service.decision.belief import USUAL, BeliefGrid
from service.decision.evidence import Evidence, Floats, Refusal

GAIN_AGREED = 0.7  # Eq. 1: direction and magnitude agree
GAIN_SMALL = 0.3  # Eq. 1: direction says "no error on this axis"
STEP_CONTRADICTORY = 3.0  # Eq. 1: they contradict; trust the direction (mm or deg)
CLIP_LATER = 4.0  # Eq. 1: |C| after the first trial (mm or deg)


@dataclass(frozen=True, slots=True)
class Command:
    """The next move, (mm, deg) added to the object's pose, its reason, and the belief behind it (for display)."""

    dx_mm: float
    dtheta_deg: float
    controller: ControllerName
    reason: str
    belief: "BeliefPicture | None" = None


@dataclass(frozen=True, slots=True)
class BeliefPicture:
    """Belief over the *current* error before the move: probabilities [nx, ntheta] on cell centres in mm and deg."""

    x_mm: Floats
    theta_deg: Floats
    probability: Floats


class Controller(Protocol):
    """Turns the evidence of a blocked attempt into the next move; remembers the attempts of one insertion."""

    name: ControllerName

    def decide(self, evidence: Evidence, attempt: int) -> Command:
        """The move after ``attempt`` (1-based) was blocked; raise Refusal on a non-finite estimate."""

    def blocked_without_evidence(self) -> None:
        """Account for a blocked attempt without a decision; its pose is still known to have failed."""


def axis_command(sign: int, estimate: float, *, first: bool) -> float:
    """Eq. 1 for one axis: ``sign`` is +1 for a positive error, and an agreeing estimate is moved against.

    An estimate of exactly 0 with a sign counts as contradictory. Raises Refusal if the estimate is not finite.
    """
    if not np.isfinite(estimate):
        raise Refusal("non_finite", f"estimated error {estimate}, expected a finite number")
    if sign == 0:
        command = -GAIN_SMALL * estimate
    elif sign * estimate > 0:
        command = -GAIN_AGREED * estimate
    else:
        command = -STEP_CONTRADICTORY * sign
    return command if first else float(np.clip(command, -CLIP_LATER, CLIP_LATER))


def within(command: Command, limits: Limits) -> Command:
    """The same command, shortened to the service's limits; raises Refusal if it is not finite."""
    if not np.isfinite([command.dx_mm, command.dtheta_deg]).all():
        raise Refusal("non_finite", f"command ({command.dx_mm}, {command.dtheta_deg}) is not finite")
    dx = float(np.clip(command.dx_mm, -limits.max_dx_mm, limits.max_dx_mm))
    dtheta = float(np.clip(command.dtheta_deg, -limits.max_dtheta_deg, limits.max_dtheta_deg))
    return replace(command, dx_mm=dx, dtheta_deg=dtheta)


@dataclass(slots=True)
class Heuristic:
    """The paper's controller, with the sign convention that makes its Eq. 1 work; it forgets earlier attempts."""

    limits: Limits
    name: ControllerName = "heuristic"

    def decide(self, evidence: Evidence, attempt: int) -> Command:
        """Eq. 1 on both axes, the signs taken from the most probable class."""
        best, first = evidence.best, attempt == 1
        dx = axis_command(best.sign_x, evidence.error[0], first=first)
        dtheta = axis_command(best.sign_theta, evidence.error[1], first=first)
        reason = f"class {best.name} (p {evidence.confidence:.2f}), estimate {_pair(evidence.error)}"
        return within(Command(dx, dtheta, self.name, reason), self.limits)

    def blocked_without_evidence(self) -> None:
        """Nothing to remember."""


@dataclass(slots=True)
class Belief:
    """A Bayes filter over the initial error of the insertion; moves are known, creep in the hand is expected.

    When an attempt's evidence contradicts all the others, the belief restarts from it and the heuristic moves.
    """

    limits: Limits
    name: ControllerName = "belief"
    grid: BeliefGrid = field(default_factory=BeliefGrid)

    def decide(self, evidence: Evidence, attempt: int) -> Command:
        """Multiply the evidence in, then aim for the best chances of the next attempt and the one after."""
        consistent = self.grid.absorb(evidence)
        self.grid.creep()
        if not consistent:
            fallback = Heuristic(self.limits).decide(evidence, attempt)
            reason = f"evidence contradicts the earlier attempts, heuristic used: {fallback.reason}"
            return self._moved(Command(fallback.dx_mm, fallback.dtheta_deg, self.name, reason, self._picture()))
        (dx, dtheta), hit = self.grid.best_move()
        mean, spread = self.grid.moments()
        reason = f"belief {_pair(mean)} +- {_pair(spread)}, next attempt inserts with p {hit:.2f}"
        reason += f", networks trusted with p {self.grid.trust:.2f}"
        return self._moved(Command(dx, dtheta, self.name, reason, self._picture()))

    def blocked_without_evidence(self) -> None:
        """The pose failed; no move follows."""
        self.grid.absorb_failure()
        self.grid.creep()

    def _picture(self) -> BeliefPicture:
        return BeliefPicture(self.grid.current_x_mm, self.grid.current_theta_deg, self.grid.probability.copy())

    def _moved(self, command: Command) -> Command:
        limited = within(command, self.limits)
        self.grid.move(limited.dx_mm, limited.dtheta_deg)
        return limited


def _pair(values: tuple[float, float]) -> str:
    return f"({values[0]:+z.1f} mm, {values[1]:+z.1f} deg)"


def make_controller(
    name: ControllerName,
    limits: Limits,
    grasp_height_mm: float | None = None,
    expected: Expectations = USUAL,
    length_mm: float | None = None,
) -> Controller:
    """A new controller for one insertion; the belief's expectations of attempts come from the networks' card.

    ``length_mm``: length of the held object along the gap, None if the gripper does not report it.
    """
    return (
        Belief(limits, grid=BeliefGrid(grasp_height_mm, expected, length_mm)) if name == "belief" else Heuristic(limits)
    )
