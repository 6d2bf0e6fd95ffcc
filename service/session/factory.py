"""Builds sessions; the simulator's lock-step loop uses the same call as the real-time service."""

from service.contract import FINGERS
from service.contract.wire import ControllerName, Limits
from service.decision.models import ModelSet
from service.perception.finger import TactileFinger
from service.perception.rectification import Calibration
from service.session.state_machine import DEFAULT_LIMITS, InsertionSession


def make_session(
    models: ModelSet,
    calibration: Calibration | None = None,
    controller: ControllerName = "belief",
    limits: Limits = DEFAULT_LIMITS,
    *,
    imprint: bool = True,
) -> InsertionSession:
    """A session with new perception of both fingers; without ``calibration`` it accepts rectified frames only.

    ``imprint``: slides of the imprint between the markers stop the arm, too.
    """
    spec = models.card.frame
    cameras = (calibration.left, calibration.right) if calibration else (None, None)
    left, right = (
        TactileFinger(finger, spec, own, beside=other, imprint=imprint)
        for finger, own, other in zip(FINGERS, cameras, cameras[::-1], strict=True)
    )
    return InsertionSession(models, left, right, controller, limits)
