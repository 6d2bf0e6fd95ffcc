"""Perception of one finger as the session uses it: rectification, tracking, slip and the onset of motion."""

import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from service.contract import ContractError, Finger, FrameSpec, TactileFrame
from service.perception.identity import cause, compared, unlike
from service.perception.markers.liveness import Liveness
from service.perception.markers.tracker import MarkerTracker
from service.perception.observation import Observation
from service.perception.rectification import CameraCalibration, Rectifier
from service.perception.slip.detector import SlipDetector, SlipState, untouched
from service.perception.slip.imprint import ImprintWatch
from service.perception.slip.onset import OnsetDetector
from service.perception.slip.open_gel import OpenGel, shrunk

_MOVED = 0.5  # times the limit of an untouched gel; noise and JPEG move copies of one picture by 0.2 at most
_PRESSED = 2.0  # times the bulge limit of an untouched gel; beyond it an object is certainly held


class TactileFinger:
    """One finger's perception chain; accepts rectified frames and, with a calibration, raw ones.

    Where both have one size, as of the GelSight Mini, a frame is raw if there is a calibration.
    ``spec`` is the rectified frame that the networks expect; ``beside``: the other finger's calibration, by which
    swapped cameras are known; ``imprint``: also follow the imprint.
    """

    def __init__(
        self,
        finger: Finger,
        spec: FrameSpec,
        calibration: CameraCalibration | None = None,
        *,
        beside: CameraCalibration | None = None,
        imprint: bool = True,
    ) -> None:
        self.finger = finger
        self._spec = spec
        self._rectifier = Rectifier(calibration) if calibration else None
        self._measured = calibration.measured if calibration else None
        self._beside = beside
        self._tracker = MarkerTracker()
        self._liveness = Liveness()
        self._slip = SlipDetector()
        self._onset = OnsetDetector()
        self._open = OpenGel()
        self._imprint = ImprintWatch() if imprint else None
        self.gel_distance: float | None = None
        self._rearm = False
        self._held = False
        self._stopped = False
        self._other = False  # whether the open gel was refused as another one

    def rearm(self) -> None:
        """The next frame becomes the reference of slip and onset; tracking continues."""
        self._rearm = True
        self._liveness.rearm()

    def learn_open(self, frame: TactileFrame) -> str:
        """Take the frame as the open gel, touched by nothing; returns why that cannot be, or "".

        Its grid is followed from now on: a grid sought in a deformed gel may lack whole rows. A gel other than the
        calibrated one is refused: a swapped camera looks right by itself.
        """
        image, _ = self._rectified(frame)
        self._other, tracker = False, MarkerTracker()
        field = tracker.update(image, frame.captured_ns)
        try:
            self._open.learn(field, shrunk(image))
        except ValueError as error:
            return str(error)
        self._liveness.learn_open(image)
        known = compared(self._measured, image, field)
        self.gel_distance = None if known.alike is None else 1.0 - known.alike
        why = unlike(known)
        self._other = bool(why)
        if not why:
            self._tracker = tracker
        return why

    def explain(self, frame: TactileFrame) -> str:
        """Why the frame refused last does not show the calibrated gel, or ""; takes as long as learning it."""
        return cause(self._beside, frame.pixels) if self._other else ""

    def forget_open(self) -> None:
        """What was learnt as the open gel was none: only its print can tell whether it is touched."""
        self._open, self._liveness, self.gel_distance = OpenGel(), Liveness(), None

    def observe(self, frame: TactileFrame) -> Observation:
        """Perceive a frame; raise ContractError if it is neither raw nor rectified."""
        image, rectify_ms = self._rectified(frame)
        rectified = time.perf_counter()
        tracked_field = self._tracker.update(image, frame.captured_ns)
        tracked = time.perf_counter()
        bulge, small = self._open.bulge(tracked_field), shrunk(image)
        shaded = (self._open.shade(small) or 0.0) >= 1.0
        changed = bulge is None or bulge >= _MOVED or shaded
        field = self._liveness.checked(image, tracked_field, changed=changed)
        marked = field if shaded else self._open.mark(field)  # a push may bring markers home that a weight moved
        if self._rearm:
            slip = self._slip.rearm(field)
            self._onset.rearm(field)
            self._held = (bulge or 0.0) > _PRESSED
            self._rearm = self._stopped = False
            onset_ns = None
        else:
            slip = self._slip.update(marked if self._held else field)
            onset_ns = self._onset.update(field)
        slip = self._with_contact(slip, empty=untouched(marked))
        touch = self._open.touch(field, small)
        weight = self._open.weight(field)
        slipped = time.perf_counter()
        imprint = self._imprint.update(image, field) if self._imprint else None
        cost_ms = {
            "rectify": rectify_ms,
            "markers": (tracked - rectified) * 1e3,
            "slip": (slipped - tracked) * 1e3,
            "imprint": (time.perf_counter() - slipped) * 1e3,
        }
        stamps, certain_ns = (frame.seq, frame.captured_ns), self._liveness.certain_ns
        observation = Observation(self.finger, *stamps, image, field, slip, onset_ns, cost_ms, bulge, touch, imprint)
        return replace(observation, weight=weight, certain_ns=certain_ns)

    def _with_contact(self, slip: SlipState, *, empty: bool) -> SlipState:
        """The state, or "no_contact" where nothing touches the gel; the first state that stops the arm always passes.

        An object too flat and too lightly held to bulge the gel looks like none: then only the word changes, and slip
        is still measured from its reference. After an object that bulged the gel, a gel at rest is a release.
        """
        first, self._stopped = slip.stop and not self._stopped, slip.stop or self._stopped
        if first or not empty:
            return slip
        return replace(slip, state="no_contact", reason="nothing touches the gel")

    def _rectified(self, frame: TactileFrame) -> tuple[NDArray[np.uint8], float]:
        """The rectified image, and the milliseconds it took."""
        pixels, started = frame.pixels, time.perf_counter()
        is_raw = self._rectifier is not None and pixels.shape == self._rectifier.camera.raw.shape
        if pixels.shape == self._spec.shape and not is_raw:
            return pixels, 0.0
        if self._rectifier is None:
            height, width = pixels.shape[:2]
            expected = f"{self._spec.width_px} x {self._spec.height_px}"
            raise ContractError(
                f"{self.finger} frame is {width} x {height}, expected {expected} rectified; pass --calibration"
            )
        image = self._spec.check(self._rectifier.apply(pixels))
        return image, (time.perf_counter() - started) * 1e3
