"""The service's session in lock step, with fingers that see pictures or the simulated gel itself."""

from collections.abc import Mapping

from service.contract import FINGERS, Finger
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
    return InsertionSession(models, left, right, controller_name="belief" if controller == "oracle" else controller)


def _finger(
    models: ModelSet, cell: LockstepCell, index: int, perception: Perception, troubles: Mapping[Finger, Trouble]
) -> FingerWatch:
    if perception == "fields":
        return TrueFieldFinger(cell, FINGERS[index], troubles.get(FINGERS[index]))
    return TactileFinger(FINGERS[index], models.card.frame, cell.calibration(index))
