"""Recorded grasps as a session watches them: its two fingers with their slip settings, and the witness of both.

No client arms in a recording. It is armed here once the grasp is held and both fingers' markers are at rest, as a
client arms before each descent; and again where they rest elsewhere, and after a stop. The arm does not descend in it,
so a patch that stops moving may be an object at rest, which a session would not judge.
"""

import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.contract import FINGERS, Finger, FrameSpec, TactileFrame
from service.perception.finger import TactileFinger
from service.perception.markers.field import MarkerField
from service.perception.observation import Observation
from service.perception.rectification import CameraCalibration
from service.perception.slip.grasp import Standstill, moved
from service.session.fingers import IMPRINT_SLIDES, Fingers

Image = NDArray[np.uint8]
SHARES = (50, 95, 99)
CAUSES = ("markers", "stalled", "imprint", "other")


class LiveWatch:
    """A session's fingers, armed at rest; each finger's pictures have the size of its first one, in ``pictures``."""

    def __init__(self, pictures: Sequence[Image], open_gels: Sequence[TactileFrame] = ()) -> None:
        self.left, self.right = (_finger(finger, picture) for finger, picture in zip(FINGERS, pictures, strict=True))
        self._fingers = Fingers(self.left, self.right)
        self.refused = [why for frame in open_gels if (why := self._fingers.watch(frame.finger).learn_open(frame))]
        self._still = [Standstill() for _ in FINGERS]
        self._references: list[MarkerField] = []
        self._arming = False
        self.spent_ms: list[dict[str, float]] = []

    @property
    def armed(self) -> bool:
        return bool(self._references)

    def update(self, frames: Sequence[TactileFrame], *, held: bool) -> set[str]:
        """Why an armed arm stops at this frame of each finger (``CAUSES``); empty if it does not.

        A slide of the imprint disarms nothing here, so that what the markers alone detect is known, too.
        """
        if self._arming:
            self.left.rearm()
            self.right.rearm()
        observed = [self._observe(frame) for frame in frames]
        if self._arming:
            self._arming = False
            self._references = [one.field for one in observed] if all(one.informative for one in observed) else []
        causes = {_cause(one) for one in observed if one.slip.stop} if self.armed else set()
        rests = [still.update(one.field) for still, one in zip(self._still, observed, strict=True)]
        if causes - {"imprint"}:
            self._references = []
            for still in self._still:
                still.forget()
        elif held and all(rests):
            known = zip(self._references, observed, strict=False)
            self._arming = not self.armed or any(moved(reference, one.field) for reference, one in known)
        return causes

    def _observe(self, frame: TactileFrame) -> Observation:
        begun = time.process_time()
        observation = self._fingers.observe(frame)
        self.spent_ms.append({"whole": 1e3 * (time.process_time() - begun), **observation.cost_ms})
        return observation


def _finger(finger: Finger, picture: Image) -> TactileFinger:
    spec = FrameSpec(height_px=picture.shape[0], width_px=picture.shape[1])
    itself = CameraCalibration(np.eye(3), spec, spec)  # changes no picture, but costs what any calibration does
    return TactileFinger(finger, spec, itself)


def _cause(observation: Observation) -> str:
    """Markers that lag, a patch that stopped moving, the imprint; or no slip: a release, too far a motion, no sight."""
    if not observation.slip.slip:
        return "other"
    if observation.slip.reason == IMPRINT_SLIDES:
        return "imprint"
    return "markers" if observation.slip.score >= 1 else "stalled"


def stops_of(
    pairs: Callable[[], Iterator[Sequence[Image]]], open_frame: int | None, held: range, rate_hz: float
) -> dict[str, Any]:
    """The frames of a held grasp in which an armed arm would be stopped, by cause, and those in which it is armed.

    ``pairs`` begins anew with both fingers' pictures. ``refused``: gels that were not taken as open. ``cost_ms``: CPU
    of a finger and frame, all in, and time of its parts: median, 95th and 99th percentile.
    """
    begin = open_frame if open_frame is not None and open_frame < held.start else 0
    opened: list[TactileFrame] = []
    if open_frame is not None:  # learnt before the grasp, although it may have been recorded after it
        opened = _taken(begin - 1, next(itertools.islice(pairs(), open_frame, None)), rate_hz)
    watch = LiveWatch(next(pairs()), opened)
    frames: dict[str, list[int]] = {cause: [] for cause in ("armed", *CAUSES)}
    for k, pair in enumerate(itertools.islice(pairs(), begin, held.stop), begin):
        causes = watch.update(_taken(k, pair, rate_hz), held=k in held)
        if k in held:
            for each in causes | ({"armed"} if watch.armed or causes else set()):
                frames[each].append(k)
    cost_ms = {
        part: np.percentile([one[part] for one in watch.spent_ms], SHARES).round(3).tolist()
        for part in watch.spent_ms[0]
    }
    return {f"{each}_frames": those for each, those in frames.items()} | {"refused": watch.refused, "cost_ms": cost_ms}


def _taken(k: int, pair: Sequence[Image], rate_hz: float) -> list[TactileFrame]:
    return [
        TactileFrame(finger, k, round(k * 1e9 / rate_hz), image) for finger, image in zip(FINGERS, pair, strict=True)
    ]
