"""How long each stage of an attempt may take before the session says so."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Deadlines:
    """How long each stage may take before the session says so."""

    reference_s: float = 2.0  # from `arm` to the first pair captured after it
    decision_frames_s: float = 2.0  # from `stopped` to the last frame the networks need
    decision_s: float = 10.0  # from `stopped` to the networks' result
