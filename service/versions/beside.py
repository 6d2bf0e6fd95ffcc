"""Versions that run beside the active one in an insertion: the same evidence, their own answers, nothing moved."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from service.contract.wire import Arm, ControllerName, Correction, Limits
from service.contract.wire_parts import errors_left
from service.decision.attempt import Attempt
from service.decision.controllers import Belief, Command, Controller, make_controller
from service.decision.evidence import Evidence, Refusal
from service.decision.models import ModelSet
from service.decision.work import check_evidence, decide_again
from service.versions.contest import Held, held, log_score


@dataclass(slots=True)
class Beside:
    """What versions would have answered in one insertion; of ``networks`` by version the ``active`` one decides it.

    Not thread safe: the recorder's thread asks :meth:`decide`, and once it has ended somebody asks for the scores.
    """

    active: str
    networks: Mapping[str, ModelSet]
    limits: Limits
    controller: ControllerName
    _controllers: dict[str, Controller] = field(default_factory=dict)
    _first: dict[str, Evidence | None] = field(default_factory=dict)
    _arm: Arm | None = None
    _moves: list[tuple[float, float]] = field(default_factory=list)

    def decide(self, attempt: Attempt) -> dict[str, Any]:
        """The answer of each but the active version to a decided attempt, as plain data."""
        decision, made = attempt.decision, (0.0, 0.0)
        felt: dict[str, Evidence | None] = {self.active: None}
        if isinstance(decision, Correction):
            made = decision.dx_mm, decision.dtheta_deg
            felt[self.active] = attempt.result.evidence if attempt.result else None
        answers = {name: self._answer(name, attempt, made, felt) for name in self.networks if name != self.active}
        if not self._moves:
            self._first, self._arm = felt, attempt.arm
        self._moves.append(made)
        return answers

    def _answer(
        self, name: str, attempt: Attempt, made: tuple[float, float], felt: dict[str, Evidence | None]
    ) -> dict[str, Any]:
        """What a version would do; its belief goes on with the move that was ``made`` instead."""
        models = self.networks[name]
        controller = self._controllers.get(name) or self._new_controller(models, attempt.arm)
        self._controllers[name] = controller
        felt[name] = command = None
        try:
            evidence = decide_again(models, attempt)
            check_evidence(models, attempt, evidence)
            command = controller.decide(evidence, attempt.arm.attempt)
            felt[name], answer = evidence, _facts(evidence, command)
        except Refusal as refusal:
            answer = {"refused": refusal.reason, "detail": str(refusal)}
        except Exception as error:
            answer = {"refused": "non_finite", "detail": f"the networks failed: {error}"}
        if command is None:
            controller.blocked_without_evidence()
        if isinstance(controller, Belief):
            wanted = (command.dx_mm, command.dtheta_deg) if command else (0.0, 0.0)
            controller.grid.move(made[0] - wanted[0], made[1] - wanted[1])
        return answer

    def _new_controller(self, models: ModelSet, arm: Arm) -> Controller:
        known = arm.grasp_height_mm, models.card.expectations, arm.gripper_width_mm
        return make_controller(self.controller, self.limits, *known)

    def scores(self) -> dict[str, tuple[float, Held]]:
        """The score of each version's first answer in an insertion that went in, and which intervals held."""
        if self._arm is None:
            return {}
        arm, error = self._arm, errors_left(self._moves)[0]
        return {
            name: (log_score(self.networks[name], evidence, arm, error), held(evidence, error))
            for name, evidence in self._first.items()
        }


def _facts(evidence: Evidence, command: Command) -> dict[str, Any]:
    return {
        "dx_mm": command.dx_mm,
        "dtheta_deg": command.dtheta_deg,
        "confidence": min(1.0, evidence.confidence),
        "estimate": evidence.estimate().model_dump(mode="json"),
    }
