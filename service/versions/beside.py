"""Versions that run beside the active one in an insertion: the same evidence, their own answers, no motion."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from service.contract.wire import (
    Cause,
    ControllerName,
    Correction,
    DoubtReason,
    Finished,
    Limits,
    NoDecision,
    NoDecisionReason,
)
from service.contract.wire_parts import errors_left
from service.decision.attempt import Attempt
from service.decision.belief import BeliefGrid
from service.decision.controllers import Belief, Command, Heuristic
from service.decision.evidence import Evidence, Refusal
from service.decision.models import ModelSet
from service.decision.work import check_evidence, decide_again, unknown_depth
from service.versions.contest import Held, intervals_hold, log_score

BLAMED: frozenset[Cause] = frozenset({"attempts", "no_decision", "not_confirmed"})
"""Causes of an end that decisions may be responsible for."""
UNBLAMED: frozenset[DoubtReason] = frozenset({"neighbours", "not_seen", "width", "order", "depth"})
"""Doubts of full depth that the cell, its cameras or its client cause."""
UNSEEN: frozenset[NoDecisionReason] = frozenset({"no_motion", "stale", "too_few_frames"})
"""Reasons for no decision that they cause, unless it was the networks that were late."""
Move = tuple[float, float]


@dataclass(slots=True)
class Beside:
    """Answers of versions in one insertion; of ``networks`` by version the ``active`` one decides it.

    Each version has its own belief, updated with the moves that were made, and so predicts whether the next attempt
    inserts. ``scores``: the quality of these predictions, in order of the attempts. ``undecided``: of the attempts
    without a decision since the last correction, whether the active one's networks may be why. Not thread safe: the
    recorder's thread calls :meth:`decide`; the other methods are called after it has ended.
    """

    active: str
    networks: Mapping[str, ModelSet]
    limits: Limits
    controller: ControllerName
    scores: list[dict[str, float]] = field(default_factory=list)
    undecided: list[bool] = field(default_factory=list)
    _beliefs: dict[str, Belief] = field(default_factory=dict)
    _chances: dict[str, float] = field(default_factory=dict)
    _first: dict[str, Evidence | None] = field(default_factory=dict)
    _moves: list[Move] = field(default_factory=list)

    def decide(self, attempt: Attempt) -> dict[str, Any]:
        """The answers of all but the active version to a decided attempt, as plain data."""
        if attempt.outcome == "blocked":
            self._came_out(inserted=False)
        decision, made = attempt.decision, (0.0, 0.0)
        if isinstance(decision, Correction):
            made = decision.dx_mm, decision.dtheta_deg
            self.undecided.clear()
        elif isinstance(decision, NoDecision):
            late = attempt.fed and attempt.result is None and unknown_depth(attempt) is None
            self.undecided.append(late or decision.reason not in UNSEEN)
        felt, answers = dict[str, Evidence | None](), dict[str, Any]()
        for name in self.networks:
            evidence, refusal = self._evidence(name, attempt)
            command = self._follow(name, attempt, evidence, made)
            felt[name] = evidence
            if name != self.active:
                answers[name] = refusal if evidence is None or command is None else _facts(evidence, command)
        self._first = self._first or felt
        self._moves.append(made)
        self._chances = {name: belief.grid.enters() for name, belief in self._beliefs.items()}
        return answers

    def _evidence(self, name: str, attempt: Attempt) -> tuple[Evidence | None, dict[str, str]]:
        """A version's evidence from an attempt, or why it refuses."""
        if name == self.active:
            acted = isinstance(attempt.decision, Correction) and attempt.result is not None
            return (attempt.result.evidence if acted and attempt.result else None), {}
        try:
            evidence = decide_again(self.networks[name], attempt)
            check_evidence(self.networks[name], attempt, evidence)
        except Refusal as refusal:
            return None, {"refused": refusal.reason, "detail": str(refusal)}
        except Exception as error:
            return None, {"refused": "non_finite", "detail": f"the networks failed: {error}"}
        return evidence, {}

    def _follow(self, name: str, attempt: Attempt, evidence: Evidence | None, made: Move) -> Command | None:
        """A version's command; its belief is updated with the move that was ``made`` instead."""
        arm = attempt.arm
        if (belief := self._beliefs.get(name)) is None:
            expected = self.networks[name].card.expectations
            grid = BeliefGrid(arm.grasp_height_mm, expected, arm.gripper_width_mm)
            belief = self._beliefs[name] = Belief(self.limits, grid=grid)
        before = belief.grid.offset.copy()
        command = None
        if evidence is None:
            belief.blocked_without_evidence()
        else:
            command = belief.decide(evidence, arm.attempt)
            if self.controller == "heuristic":
                command = Heuristic(self.limits).decide(evidence, arm.attempt)
        belief.grid.offset = before + made
        return command

    def _came_out(self, *, inserted: bool) -> None:
        """The attempt after the last answer is over."""
        if self._chances:
            self.scores.append({name: log_score(one, inserted=inserted) for name, one in self._chances.items()})
        self._chances = {}

    def went_in(self) -> dict[str, Held]:
        """After success: whether the intervals of each version's first answer held the error, now known."""
        self._came_out(inserted=True)
        if not self._first:
            return {}
        error = errors_left(self._moves)[0]
        return {name: intervals_hold(evidence, error) for name, evidence in self._first.items()}

    def blamed(self, finished: Finished) -> bool:
        """Whether decisions of the active version may be responsible for an insertion that failed."""
        doubted = [doubt.reason not in UNBLAMED for doubt in finished.doubts]
        blamed = self.undecided if finished.cause == "no_decision" else doubted
        return finished.cause in BLAMED and (not blamed or any(blamed))


def _facts(evidence: Evidence, command: Command) -> dict[str, Any]:
    return {
        "dx_mm": command.dx_mm,
        "dtheta_deg": command.dtheta_deg,
        "confidence": min(1.0, evidence.confidence),
        "estimate": evidence.estimate().model_dump(mode="json"),
    }
