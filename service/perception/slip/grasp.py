"""Watches a finger without a robot: the reference is taken when the grasp has settled.

In an insertion the robot client arms. In a clip, grasping, holding, slipping and releasing follow each other, and the
clip may begin in the middle. The watch arms once the markers have been at rest for a while, and again whenever they
rest elsewhere: after the fingers closed, or the object was lifted, slipped or was released. The reference is therefore
always the present grasp's, never that of open fingers.
"""

import math
from dataclasses import replace

import numpy as np

from service.perception.markers.field import MarkerField
from service.perception.slip.detector import SlipDetector, SlipSettings, SlipState, untouched
from service.perception.slip.open_gel import OpenGel
from service.perception.slip.rigid import carried_px

# At rest: no further motion within that time.
_REST_PITCH = 0.04
_SETTLE_S = 0.4
# The lowest limit without an alarm while 11 real objects were held and shaken (3,048 finger frames), and a quarter
# more; half of the recordings chose the same limit as the other half.
WATCH_SLIP_PITCH = 0.0625


def watch_settings(slip_pitch: float) -> SlipSettings:
    """Slip settings without a robot: the arm's motion is unknown, so a patch that stops may have been put down."""
    return SlipSettings(stall_pitch=math.inf, slip_pitch=slip_pitch)


class Standstill:
    """Whether one finger's markers have been at rest for a while."""

    def __init__(self) -> None:
        self._anchor: MarkerField | None = None

    def forget(self) -> None:
        """Wait anew."""
        self._anchor = None

    def update(self, field: MarkerField) -> bool:
        """Whether the markers are at rest in this field."""
        if not field.usable:
            self._anchor = None if field.status == "lost" else self._anchor
            return False
        anchor = self._anchor
        if anchor is None or anchor.valid.shape != field.valid.shape or moved(anchor, field):
            self._anchor = field
            return False
        return (field.captured_ns - anchor.captured_ns) * 1e-9 >= _SETTLE_S


def moved(anchor: MarkerField, field: MarkerField) -> bool:
    """Whether the markers of two fields rest in different places."""
    may = field.valid & anchor.valid
    step = np.asarray(field.displacement_px - anchor.displacement_px, np.float64)
    return carried_px(step, may) > _REST_PITCH * field.pitch_px


class GraspWatch:
    """Turns the fields of one finger into states, arming the slip detector whenever the grasp has settled.

    ``free`` detects an untouched gel; let it learn the untouched gel if a frame of it is available.
    """

    def __init__(self, slip: SlipSettings | None = None) -> None:
        self.free = OpenGel()
        self.detector = SlipDetector(slip or watch_settings(WATCH_SLIP_PITCH))
        self._standstill = Standstill()
        self._free = False

    def update(self, field: MarkerField) -> SlipState:
        """Classify one field; until the grasp has settled the state is "grasping", without one "no_contact"."""
        field = self.free.mark(field)
        settled = self._standstill.update(field)
        reference = self.detector.reference
        if settled and not self._free and reference is not None and moved(reference, field):
            return self.detector.rearm(field)
        if not self.detector.armed or self._free:
            if settled:
                self._free = False
                return self.detector.rearm(field)
            waiting = self.detector.update(field) if not self.detector.armed else self._grasping(field)
            return replace(waiting, state="grasping") if field.usable and not untouched(field) else waiting
        state = self.detector.update(field)
        if state.state in {"incipient_slip", "gross_slip", "release", "lost", "unknown"}:
            self._free = True
            self._standstill.forget()
        return state

    def _grasping(self, field: MarkerField) -> SlipState:
        if untouched(field):
            return self.detector.rearm(field)
        state = self.detector.update(field)
        return replace(state, score=0.0, over_limit=False, reason="waiting for the grasp to settle")
