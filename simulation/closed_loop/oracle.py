"""The oracle: answers from the ground truth, in place of the networks and the controller."""

import numpy as np

from service.contract.wire import Correction, Estimate, NoDecision
from service.decision.evidence import Evidence
from service.decision.models import ModelSet


def nothing_known(models: ModelSet) -> Evidence:
    """What networks would say that saw nothing: the oracle does not ask them."""
    classes = models.card.classes
    return Evidence(classes, np.full(len(classes), 1.0 / len(classes)), (0.0, 0.0), (10.0, 10.0))


def by_the_truth(message: Correction | NoDecision, error: tuple[float, float]) -> Correction:
    """The correction in place of ``message`` that undoes the true ``error``, (x mm, theta deg)."""
    dx, dtheta = (-part for part in error)
    return Correction(
        insertion_id=message.insertion_id,
        attempt=message.attempt,
        dx_mm=dx,
        dtheta_deg=dtheta,
        class_probabilities={},
        estimate=Estimate(dx_mm=0.0, dtheta_deg=0.0),
        confidence=0.0,
        controller="heuristic",
        reason="oracle step",
        latency_ms={},
    )
