"""One answer to each attempt: a correction if its evidence can be trusted, else ``no_decision`` with the reason.

At full depth the answer is the list of doubts against a claim (:mod:`service.decision.claim`).
"""

import time
from dataclasses import dataclass, field, replace

from service.contract import wire
from service.decision.attempt import Attempt, Stage
from service.decision.claim import GraspRecord, doubts, newest_age_s
from service.decision.consistency import Consistency
from service.decision.controllers import Command, Controller, make_controller
from service.decision.evidence import Evidence, Refusal
from service.decision.models import ModelSet
from service.decision.work import check_evidence, correction, overdue, shown_turns_deg, unknown_depth
from service.settings import Deadlines

Decision = wire.Correction | wire.NoDecision
FRESH_S, FRESH_AT_REST_S = 0.15, 0.5  # largest ages of the pair that shows what the gels carry at full depth


@dataclass(slots=True)
class Decider:
    """Decides the attempts of one insertion; ``command`` is the move of the last correction.

    ``consistency`` is None where moves other than its corrections drive the arm.
    """

    insertion_id: str
    models: ModelSet
    controller: Controller
    deadlines: Deadlines
    command: Command | None = None
    grasp: GraspRecord = field(default_factory=GraspRecord)
    consistency: Consistency | None = field(default_factory=Consistency)

    def before_descending(self, attempt: Attempt) -> list[wire.Refused]:
        """Refusals independent of an attempt's frames: the networks do not know this cell."""
        spec = self.models.card.pressing
        why = spec.outside(attempt.conditions()) if spec else ""
        return [attempt.refusal("untrained", why)] if why else []

    def conclude(self, attempt: Attempt, now_ns: int) -> Decision | None:
        """The answer to a blocked attempt, None while its frames or the networks' result may still come."""
        decision = self._decide(attempt, now_ns)
        if decision is not None:
            self.grasp.blocked(attempt)
        return decision

    def grasps(self, arm: wire.Arm, unknown: str, *, anew: bool, tried: bool) -> None:
        """The first arming with a grasp; ``anew``: the hand was open, so what others have shown is of no grasp now."""
        if anew:
            self.grasp = GraspRecord(tried=self.grasp.tried)
        self.grasp.begins(arm.gripper_width_mm, unknown, tried=tried)

    def given_up(self, attempt: Attempt) -> None:
        """An attempt ends without an answer; the arm may have gone down in it."""
        if attempt.descending_ns is not None:
            self.grasp.unfollowed(attempt)
            self.controller.blocked_without_evidence()

    def afresh(self, insertion_id: str) -> "Decider":
        """The decider for an insertion that continues with the same object, regrasped: it keeps the known error."""
        return replace(self, insertion_id=insertion_id, command=None, grasp=GraspRecord())

    def doubts(self, attempt: Attempt, now_ns: int) -> tuple[wire.Doubt, ...] | None:
        """Doubts against a claim of full depth, empty if none; None while frames may still resolve them."""
        reported_s = (now_ns - (attempt.reported_ns or now_ns)) / 1e9  # what a client states proves no standstill
        if newest_age_s(attempt.pushes, now_ns) <= max(FRESH_S, min(FRESH_AT_REST_S, reported_s)):
            return doubts(attempt, self.grasp)
        waited_s = _stood_s(attempt, now_ns)
        if waited_s <= self.deadlines.decision_frames_s:
            return None
        detail = f"no pair showed within {waited_s:.1f} s what the gels carry at full depth"
        return (wire.Doubt(reason="not_seen", detail=detail),)

    def _decide(self, attempt: Attempt, now_ns: int) -> Decision | None:
        self.command = None
        if attempt.stage is not Stage.STOPPED:
            return None
        if refusal := unknown_depth(attempt):  # at once: the frames that it lacks may never come
            return self._refuse(attempt, refusal)
        if attempt.result is None:
            refusal = overdue(attempt, _stood_s(attempt, now_ns), self.models.card, self.deadlines)
            return None if refusal is None else self._refuse(attempt, refusal)
        if attempt.result.evidence is None:
            return self._refuse(attempt, self._explained(attempt))
        return self._correct(attempt, attempt.result.evidence, attempt.result.latency_ms, now_ns)

    def _correct(self, attempt: Attempt, evidence: Evidence, latency_ms: dict[str, float], now_ns: int) -> Decision:
        started = time.perf_counter()
        try:
            check_evidence(self.models, attempt, evidence)
            if self.consistency is not None:  # first, or the controller would learn what cannot be trusted, and move
                self.consistency.add(evidence.estimate(), attempt.ring[-1])
            command = self.controller.decide(evidence, attempt.arm.attempt)
        except Refusal as refusal:
            return self._refuse(attempt, refusal)
        decided = correction(attempt, evidence, command, latency_ms)
        if self.consistency is not None:
            self.consistency.move(decided)
        latency_ms = latency_ms | {
            "controller": (time.perf_counter() - started) * 1e3,
            "since_last_frame": (now_ns - attempt.decision_pairs[-1].captured_ns) / 1e6,
        }
        self.command = command
        return decided.model_copy(update={"latency_ms": latency_ms})

    def _explained(self, attempt: Attempt) -> Refusal:
        """Why the networks gave no evidence: a mirrored picture is named, if that is what makes the fields strange."""
        assert attempt.result is not None
        refusal = attempt.result.refusal or Refusal("non_finite", "no evidence")
        if refusal.reason == "out_of_distribution" and self.consistency is not None and attempt.ring:
            try:
                self.consistency.add_sides(attempt.ring[-1])
            except Refusal as mirrored:
                return mirrored
        return refusal

    def _refuse(self, attempt: Attempt, refusal: Refusal) -> Decision:
        self.controller.blocked_without_evidence()
        turns_deg = shown_turns_deg(attempt)
        return wire.NoDecision(**attempt.named, reason=refusal.reason, detail=str(refusal), turns_deg=turns_deg)


def decider_of(
    arm: wire.Arm,
    models: ModelSet,
    name: wire.ControllerName,
    limits: wire.Limits,
    deadlines: Deadlines,
    before: Decider | None = None,
) -> Decider:
    """The decider of an insertion that begins with ``arm``; after ``before`` with the same grasp, which it knows."""
    controller = make_controller(name, limits, arm.grasp_height_mm, models.card.expectations, arm.gripper_width_mm)
    decider = Decider(arm.insertion_id, models, controller, deadlines)
    return replace(decider, grasp=before.grasp) if before else decider


def _stood_s(attempt: Attempt, now_ns: int) -> float:
    """For how long the arm has stood still."""
    assert attempt.stopped_ns is not None
    return (now_ns - attempt.stopped_ns) / 1e9
