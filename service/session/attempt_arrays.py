"""What is kept of an attempt: the pictures of its decision, and the input of the networks."""

import numpy as np
from numpy.typing import NDArray

from service.contract.model_card import CONDITIONS
from service.decision.attempt import Attempt


def arrays_of(attempt: Attempt) -> dict[str, NDArray[np.generic]]:
    """The frames of the decision, as :mod:`service.recordings.writer` documents for ``attempt_XX.npz``."""
    reference = attempt.network_reference or attempt.reference
    if reference is None:
        return {}
    pairs = attempt.decision_pairs or [reference]
    last = pairs[-1].fingers
    return {
        "frames": np.stack([pair.pixels() for pair in pairs]),
        "reference": reference.pixels(),
        "frame_seq": np.array([pair.seq for pair in pairs], np.int64),
        "captured_ns": np.array([pair.captured_ns for pair in pairs], np.int64),
        "rest_px": np.stack([finger.field.rest_px for finger in last]),
        "displacement_px": np.stack([finger.field.displacement_px for finger in last]),
        "valid": np.stack([finger.field.valid for finger in last]),
        **read_by_depth(attempt),
    }


def read_by_depth(attempt: Attempt) -> dict[str, NDArray[np.generic]]:
    """The decision, and the input of networks that read steps of depth; no pictures."""
    decision = {"decision": np.array(attempt.decision.model_dump_json() if attempt.decision else "{}")}
    if not attempt.steps or attempt.descent is None or attempt.reference is None:
        return decision
    conditions = [attempt.descent.conditions.get(name) or 0.0 for name in CONDITIONS]
    steps = {"steps": np.stack(attempt.steps), "conditions": np.array(conditions, np.float32)}
    return {**decision, **steps, "held_px": attempt.reference.markers_px()}
