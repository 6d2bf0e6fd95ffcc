"""One answer to each attempt: a correction where its evidence can be trusted, else ``no_decision`` with the reason.

At full depth the answer is ``inserted`` if the gels agree, else a fault with the push that they carry.
"""

import math
import time
from dataclasses import dataclass

from service.contract import wire
from service.decision.attempt import Attempt, Stage
from service.decision.controllers import Command, Controller
from service.decision.evidence import Evidence, Refusal
from service.decision.models import ModelSet
from service.decision.seating import seating_evidence, strongest_push
from service.decision.work import check_evidence, correction, overdue
from service.settings import Deadlines

Decision = wire.Correction | wire.NoDecision
Objections = tuple[wire.Fault, ...]


@dataclass(slots=True)
class Decider:
    """Decides the attempts of one insertion; ``command`` is the move of the last correction.

    ``blocked_pitch`` is the strongest push that the gels carried in the attempts that were blocked.
    """

    insertion_id: str
    models: ModelSet
    controller: Controller
    deadlines: Deadlines
    command: Command | None = None
    blocked_pitch: float = 0.0

    def conclude(self, attempt: Attempt, now_ns: int) -> Decision | None:
        """The answer to a blocked attempt, None while its frames or the networks' result may still come."""
        decision = self._decide(attempt, now_ns)
        if decision is not None:
            self.blocked_pitch = max(self.blocked_pitch, strongest_push(attempt.pushes))
        return decision

    def full_depth_objections(self, attempt: Attempt, now_ns: int, max_age_ms: float) -> Objections | None:
        """Faults that contradict an attempt's full depth, empty if none; None while frames may still decide it."""
        begin_ns = attempt.armed_ns if attempt.descending_ns is None else attempt.descending_ns
        newest_ns = attempt.pushes[-1].captured_ns if attempt.pushes else begin_ns
        seating = seating_evidence(attempt.pushes, begin_ns, self.blocked_pitch)
        if math.isfinite(seating.push_pitch) and (now_ns - newest_ns) / 1e6 <= max_age_ms:
            return () if seating.seated else (self._fault("not_seated", str(seating)),)
        waited_s = 0.0 if attempt.stopped_ns is None else (now_ns - attempt.stopped_ns) / 1e9
        if waited_s <= self.deadlines.decision_frames_s:
            return None
        detail = f"reached full depth, but no frame pair told within {waited_s:.1f} s what the gels feel; not claimed"
        return (self._fault("not_seen", detail),)

    def _fault(self, code: str, detail: str) -> wire.Fault:
        return wire.Fault(insertion_id=self.insertion_id, code=code, detail=detail, fatal=False)

    def _decide(self, attempt: Attempt, now_ns: int) -> Decision | None:
        self.command = None
        if attempt.stage is not Stage.STOPPED or attempt.stopped_ns is None:
            return None
        if attempt.broken:
            return self._refuse(attempt, Refusal("stale", f"a camera failed during the attempt: {attempt.broken}"))
        if attempt.result is None:
            waited_s = (now_ns - attempt.stopped_ns) / 1e9
            refusal = overdue(attempt, waited_s, self.models.card.frames_per_decision, self.deadlines)
            return None if refusal is None else self._refuse(attempt, refusal)
        if attempt.result.evidence is None:
            return self._refuse(attempt, attempt.result.refusal or Refusal("non_finite", "no evidence"))
        return self._correct(attempt, attempt.result.evidence, attempt.result.latency_ms, now_ns)

    def _correct(self, attempt: Attempt, evidence: Evidence, latency_ms: dict[str, float], now_ns: int) -> Decision:
        started = time.perf_counter()
        try:
            check_evidence(self.models, attempt, evidence)
            command = self.controller.decide(evidence, attempt.arm.attempt)
        except Refusal as refusal:
            return self._refuse(attempt, refusal)
        latency_ms = latency_ms | {
            "controller": (time.perf_counter() - started) * 1e3,
            "since_last_frame": (now_ns - attempt.decision_pairs[-1].captured_ns) / 1e6,
        }
        self.command = command
        return correction(self.insertion_id, attempt, evidence, command, latency_ms)

    def _refuse(self, attempt: Attempt, refusal: Refusal) -> Decision:
        self.controller.blocked_without_evidence()
        return wire.NoDecision(
            insertion_id=self.insertion_id,
            attempt=attempt.arm.attempt,
            reason=refusal.reason,
            detail=str(refusal),
        )
