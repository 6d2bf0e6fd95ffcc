"""The service's session in lock step, with fingers that see pictures or the simulated gel itself."""

import math
from collections.abc import Mapping

from service.contract import FINGERS, Finger
from service.contract.wire import CameraEntry
from service.decision.attempt import Attempt
from service.decision.claim import pressed_mm
from service.decision.models import ModelSet
from service.perception.finger import TactileFinger
from service.perception.observation import FingerWatch
from service.session.state_machine import InsertionSession
from simulation.closed_loop.job import Perception, Who
from simulation.closed_loop.lockstep import LockstepCell
from simulation.closed_loop.true_fields import Trouble, TrueFieldFinger


def session_of(
    models: ModelSet, cell: LockstepCell, controller: Who, perception: Perception, troubles: Mapping[Finger, Trouble]
) -> InsertionSession:
    """A new session; the oracle's moves replace a belief's."""
    left, right = (_finger(models, cell, index, perception, troubles) for index in range(2))
    entries = [
        CameraEntry(finger=one, source="simulated", state="live", frame_rate_hz=cell.scene.fps) for one in FINGERS
    ]
    name = "belief" if controller == "oracle" else controller
    return InsertionSession(models, left, right, controller_name=name, cameras=lambda: tuple(entries))


def _finger(
    models: ModelSet, cell: LockstepCell, index: int, perception: Perception, troubles: Mapping[Finger, Trouble]
) -> FingerWatch:
    if perception == "fields":
        return TrueFieldFinger(cell, FINGERS[index], troubles.get(FINGERS[index]))
    return TactileFinger(FINGERS[index], models.card.frame, cell.calibration(index))


def measured(attempt: Attempt | None, clearance_mm: float) -> dict[str, float | None]:
    """What an attempt took and showed, for its log.

    ``frames_s``: time from the onset of motion to the last frame behind the decision, s. ``below_mm``: how far below
    the tops of the blocks, which are taught as ``clearance_mm`` below the approach, the object touched, as it seems.
    """
    if attempt is None or attempt.onset_ns is None:
        return {"frames_s": None, "below_mm": None}
    pressed, pairs = pressed_mm(attempt), attempt.decision_pairs
    return {
        "frames_s": (pairs[-1].captured_ns - attempt.onset_ns) / 1e9 if pairs else None,
        "below_mm": attempt.depth_mm - pressed - clearance_mm if 0.0 < pressed < math.inf else None,
    }
