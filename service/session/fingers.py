"""Both fingers of a session: their perception, their newest observations, and their open gels."""

from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from service.cameras.capture import WAITING_N
from service.contract import FINGERS, Finger, FramePair, TactileFrame
from service.contract.wire import Doubt
from service.decision.attempt import Attempt
from service.decision.claim import WEIGHED_SHARE
from service.perception.observation import FingerWatch, Observation, PairObservation
from service.perception.slip.phases import Grasp
from service.perception.slip.slide import SlideWitness

IMPRINT_SLIDES = "the imprint slides"


@dataclass(slots=True)
class Fingers:
    """Each finger detects slip by its own markers; the imprints of both detect slides together."""

    left: FingerWatch
    right: FingerWatch
    _observations: dict[Finger, Observation] = field(default_factory=dict)
    _earlier: deque[Observation] = field(default_factory=lambda: deque(maxlen=len(FINGERS) * WAITING_N))
    grasp: Grasp = field(default_factory=lambda: Grasp(len(FINGERS)))
    _grasped_in: int = 0
    _faint: dict[Finger, float] = field(default_factory=dict)
    _witness: SlideWitness = field(default_factory=SlideWitness)

    def watch(self, finger: Finger) -> FingerWatch:
        return self.left if finger == "left" else self.right

    def observe(self, frame: TactileFrame) -> Observation:
        """Perceive a frame, and keep it as its finger's newest."""
        observation = self.watch(frame.finger).observe(frame)
        if newest := self._observations.get(frame.finger):
            self._earlier.append(newest)
        self._observations[frame.finger] = observation
        if self._slides() and not observation.slip.stop and observation.informative:
            slip = replace(observation.slip, state="gross_slip", score=1.0, reason=IMPRINT_SLIDES)
            self._observations[frame.finger] = replace(observation, slip=slip)
        return self._observations[frame.finger]

    def _slides(self) -> bool:
        """Whether both fingers' imprints, each newly examined, show that the object slides out."""
        score = self._witness.update([observation.imprint for observation in self._observations.values()])
        return score is not None and score >= 0

    def unjudged(self) -> tuple[Doubt, ...]:
        """Why the newest frames of the fingers were not judged; of a finger that has been judged, nothing."""
        return tuple(
            Doubt(reason="not_seen", detail=f"the newest frame of the {finger} finger was not judged: {why}")
            for finger in FINGERS
            if (why := self._unjudged(finger))
        )

    def _unjudged(self, finger: Finger) -> str:
        newest = self._observations.get(finger)
        if newest is None:
            return "none has come"
        return "" if newest.informative else newest.field.reason or newest.slip.reason

    def missing(self, pair: FramePair) -> list[TactileFrame]:
        """The frames of a pair that have not been perceived yet, and still can be: no newer one of the finger was."""
        return [one for one in (pair.left, pair.right) if not (self._perceived(one) or self._overtaken(one))]

    def _perceived(self, frame: TactileFrame) -> Observation | None:
        """The observation of that very frame, if it is one of the last ones."""
        known = (*self._observations.values(), *self._earlier)
        named = frame.finger, frame.seq, frame.captured_ns
        return next((one for one in known if (one.finger, one.seq, one.captured_ns) == named), None)

    def _overtaken(self, frame: TactileFrame) -> bool:
        newest = self._observations.get(frame.finger)
        return newest is not None and frame.captured_ns < newest.captured_ns

    def of(self, pair: FramePair) -> PairObservation | None:
        """The observations of a pair's own frames, which newer ones may have followed; None where one has none.

        A camera's pictures may arrive several periods after the other's.
        """
        left, right = self._perceived(pair.left), self._perceived(pair.right)
        return PairObservation(left, right) if left and right else None

    def both(self) -> PairObservation:
        """The newest observations of both fingers."""
        return PairObservation(self._observations["left"], self._observations["right"])

    def emptied(self, attempt: Attempt) -> str:
        """Why the hand counts as empty since the attempt was armed, reported once; or "".

        A finger whose picture did not show a touch at arming, as under a face that covers all of a stiff gel, is judged
        by its markers; if only the object's weight showed, by the remaining share of it. At full depth the claim checks
        whether the object is still held.
        """
        observations, before = self.both().fingers, self.grasp.whole.phase
        if attempt.generation != self._grasped_in and attempt.reference:  # arming has shown that something is held
            self._grasped_in, self.grasp = attempt.generation, Grasp(len(FINGERS), "hold")
            by_weight = attempt.reference.looks_open
            self._faint = {
                finger.finger: WEIGHED_SHARE * (finger.bulge or 1.0) if by_weight else 1.0
                for finger in attempt.reference.fingers
                if (finger.touch or 0.0) < 1.0
            }
        touches = [self._touch(finger) for finger in observations]
        phase = self.grasp.update(touches, [finger.slip.slip for finger in observations])
        if phase != "lost" or before == "lost" or attempt.outcome == "inserted":
            return ""
        return "both gels are empty: the object has left the hand"

    def _touch(self, finger: Observation) -> float | None:
        """Strength of the touch that a finger feels now, from 1 on; None: unknown."""
        if finger.finger not in self._faint:
            return finger.touch
        return None if finger.bulge is None else finger.bulge / self._faint[finger.finger]

    def stale(self, now_ns: int, allowed_ms: float) -> str:
        """Why the frames are too old, or ""; the fingers are as old as the one that is further behind."""
        newest_ns = [observation.captured_ns for observation in self._observations.values()]
        if len(newest_ns) < len(FINGERS) or (age_ms := (now_ns - min(newest_ns)) / 1e6) <= allowed_ms:
            return ""
        return f"a finger's newest frame is {age_ms:.0f} ms old; hold until it is back"


def gels_of(watches: tuple[FingerWatch, ...], attempt: Attempt | None) -> dict[str, float | None]:
    """Facts about the gels for the summary, from the last reference and the open gels; unknown ones are omitted."""
    known = [watch.gel_distance for watch in watches if watch.gel_distance is not None]
    facts: dict[str, float | None] = {"gel_distance": round(max(known), 4)} if known else {}
    if attempt is not None and attempt.reference is not None:
        fingers = attempt.reference.fingers
        shares = [float(one.field.valid.mean()) if one.field.valid.size else 0.0 for one in fingers]
        brightness = float(np.mean([one.image.mean() for one in fingers]))
        facts |= {"markers_share": round(min(shares), 4), "brightness_grey": round(brightness, 2)}
    return facts
