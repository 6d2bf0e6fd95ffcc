"""Whether an open gel is the one that its camera was calibrated with: by its print, or with few markers by its light.

Which of few markers are found decides how alike two prints seem. Own prints of real gels with 30 to 75 markers were
0.29 to 1.00 alike, others' up to 0.93; their lights told all of them apart
(docs/decisions/0224-few-markers-leave-the-gel-to-its-light.md).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.contract import FINGERS, Finger
from service.perception.light import OTHER_LIGHT, light_apart, light_of
from service.perception.markers.field import MarkerField
from service.perception.markers.fingerprint import (
    OTHER_GEL,
    SAME_GEL,
    TELLING_N,
    fingerprint_of,
    gel_name,
    likeness,
    markers_n,
)
from service.perception.markers.tracker import MarkerTracker
from service.perception.rectification import Calibration, CameraCalibration, Measured, Rectifier


class Compared(NamedTuple):
    """An open gel beside a calibrated one: how alike their prints are, how far apart their lights, markers found."""

    alike: float | None
    apart: float | None
    found_n: int

    @property
    def same(self) -> bool | None:
        """Whether they are one gel; None: that cannot be told."""
        if self.found_n >= TELLING_N:
            return None if self.alike is None else self.alike >= OTHER_GEL
        if self.apart is None:
            return None
        return self.apart < OTHER_LIGHT or (self.alike is not None and self.alike >= SAME_GEL)

    def __str__(self) -> str:
        if self.found_n >= TELLING_N:
            return f"fingerprints {self.alike:.2f} alike, expected {OTHER_GEL:g}"
        return f"light {self.apart:.1%} apart, allowed {OTHER_LIGHT:.0%}"


def compared(measured: Measured | None, image: NDArray[np.uint8], field: MarkerField) -> Compared:
    """An open gel's rectified picture and markers beside what was measured at a calibration."""
    found_n = int(field.valid.sum())
    if measured is None:
        return Compared(None, None, found_n)
    alike = likeness(measured.fingerprint, fingerprint_of(field))
    return Compared(alike, light_apart(measured.light, light_of(image)), found_n)


def unlike(known: Compared) -> str:
    """That it is not the calibrated gel, and by how much, or "" where it may be."""
    return f"this is not the gel that the camera was calibrated with ({known})" if known.same is False else ""


def cause(beside: CameraCalibration | None, raw: NDArray[np.uint8]) -> str:
    """Why a raw frame may not show the calibrated gel; ``beside`` is the other finger's."""
    if beside is not None and shows(beside, raw):
        return "it is the other finger's: the cameras are swapped, or one serves both fingers"
    return "has the camera moved, is it another gel, or does something touch or light it?"


def doubt(own: CameraCalibration, beside: CameraCalibration, raw: NDArray[np.uint8]) -> str:
    """Why a camera's frame does not show the open gel that it was calibrated with, or "" where it may."""
    known = _of_raw(own, raw)
    why = "" if known is None else unlike(known)
    return f"{why}: {cause(beside, raw)}" if why else ""


def shows(camera: CameraCalibration, raw: NDArray[np.uint8]) -> bool:
    """Whether a raw frame certainly shows the open gel that ``camera`` was calibrated with."""
    known = _of_raw(camera, raw)
    return known is not None and known.same is True


def _of_raw(camera: CameraCalibration, raw: NDArray[np.uint8]) -> Compared | None:
    """A raw frame beside a calibration; None if it has another size."""
    if raw.shape != camera.raw.shape:
        return None
    image = Rectifier(camera).apply(raw)
    return compared(camera.measured, image, MarkerTracker().update(image, 0))


def gel_names(calibration: Calibration | None) -> dict[Finger, str]:
    """Names of the calibrated gels, of those that are known."""
    measured = {finger: calibration.camera(finger).measured for finger in FINGERS} if calibration else {}
    return {finger: gel_name(one.fingerprint) for finger, one in measured.items() if one and one.fingerprint}


def untold(calibration: Calibration | None) -> str:
    """Of which fingers another gel would not be noticed, and why; or ""."""
    measured = {finger: calibration.camera(finger).measured for finger in FINGERS} if calibration else {}
    without = [
        finger for finger, one in measured.items() if one and not one.light and markers_n(one.fingerprint) < TELLING_N
    ]
    if not without:
        return ""
    return f"{' and '.join(without)}: calibrated without the light of the gel, so another gel is not noticed"
