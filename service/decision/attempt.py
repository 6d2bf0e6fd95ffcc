"""One attempt of an insertion: from the reference to the frames behind the decision."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.contract import FINGERS, Finger, ModelCard, TactileFrame, wire
from service.contract.wire import Arm, Armed, Correction, Descending, NoDecision, Outcome, Refused, Watching
from service.decision.evidence import DecisionRun, Evidence, Refusal
from service.decision.held_tilt import HeldTilt
from service.decision.network_input import Descent
from service.decision.seating import Push, push_of
from service.perception.observation import FingerWatch, Observation, PairObservation, nothing_held
from service.perception.pressing import Legs
from service.perception.slip.onset import OnsetDetector

RING_PAIRS = 24  # the onset is confirmed a few frames late; the ring reaches back past it
LEAST_WIDTH_MM = 2.0  # fingers closer than this hold nothing but each other


class Stage(Enum):
    """Progress of an attempt."""

    ARMING = auto()  # waiting for the first pair captured after `arm`
    STRAIGHTENING = auto()  # the tool is tilted; `arm` of the same attempt follows
    ARMED = auto()  # reference taken, watching for motion and slip
    STOPPED = auto()  # the arm stands still; the decision may still lack frames
    DECIDED = auto()  # correction or no_decision was sent


@dataclass(frozen=True, slots=True)
class WorkResult:
    """Result of the model thread: evidence or a refusal for one attempt, the time it took, and the run it ended."""

    insertion_id: str
    generation: int
    evidence: Evidence | None
    refusal: Refusal | None
    latency_ms: dict[str, float]
    run: DecisionRun | None = None


def implausible_width(arm: Arm) -> str:
    """Why the gripper's width cannot be that of a held object, or ""."""
    if arm.gripper_width_mm is None or arm.gripper_width_mm >= LEAST_WIDTH_MM:
        return ""
    return f"the fingers are {arm.gripper_width_mm:.1f} mm apart, a held object keeps them at least {LEAST_WIDTH_MM:g}"


@dataclass(slots=True)
class Attempt:
    """State of one attempt; ``generation`` separates a re-armed attempt's late results from its current ones.

    ``fed``: the networks have received their last input. ``stop_ns``: capture of the frame that stopped the arm.
    ``tilt``: of the object in the hand, and of the tool against it. ``inserts``: not a probe, which may not know it.
    """

    arm: Arm
    armed_ns: int
    generation: int
    tilt: HeldTilt = field(default_factory=HeldTilt)
    inserts: bool = True
    stage: Stage = Stage.ARMING
    reference: PairObservation | None = None
    armed: Armed | None = None
    refused: Refused | None = None
    descending_ns: int | None = None
    leg_ns: int | None = None  # start of its present speed
    legs: Legs = field(default_factory=Legs)
    pushes: list[Push] = field(default_factory=list)
    ring: deque[PairObservation] = field(default_factory=lambda: deque(maxlen=RING_PAIRS))
    onset_ns: int | None = None
    onset_again: tuple[OnsetDetector, ...] = ()
    decision_pairs: list[PairObservation] = field(default_factory=list)
    network_reference: PairObservation | None = None
    run: DecisionRun | None = None
    descent: Descent | None = None
    steps: list[NDArray[np.float32]] = field(default_factory=list)
    speed_mm_s: float | None = None
    start_mm: float = 0.0
    fed: bool = False
    watched_ns: int = 0
    _informed_ns: dict[Finger, int] = field(default_factory=dict)
    slip_sent: bool = False
    stop_ns: int | None = None
    stale_sent: bool = False
    stopped_ns: int | None = None  # when the arm came to rest, as its client states
    reported_ns: int | None = None  # when that was reported
    outcome: Outcome | None = None
    depth_mm: float = 0.0
    gripper_width_mm: float | None = None
    rearmed: set[Finger] = field(default_factory=set)
    problem: str = ""
    broken: str = ""
    result: WorkResult | None = None
    decision: Correction | NoDecision | None = None

    @property
    def spoilt(self) -> bool:
        """Whether its reference is no longer valid: a stop was sent, or a camera has failed since."""
        return self.slip_sent or self.stale_sent or bool(self.broken)

    def awaits(self, result: WorkResult) -> bool:
        """Whether a result is of this attempt since it was armed, and of its present onset of motion."""
        named = result.insertion_id, result.generation
        return named == (self.arm.insertion_id, self.generation) and result.run is self.run

    def rearm(self, watch: FingerWatch, frame: TactileFrame) -> None:
        """Let the first frame of a finger captured after `arm` become the reference of its slip and onset."""
        if self.stage is Stage.ARMING and frame.captured_ns >= self.armed_ns and frame.finger not in self.rearmed:
            watch.rearm()
            self.rearmed.add(frame.finger)

    def unread(self, observation: Observation) -> None:
        """While arming, a frame that cannot be read is no reference: the finger's next frame is tried."""
        if self.stage is Stage.ARMING and not observation.field.usable:
            self.rearmed.discard(observation.finger)
            why = f"{observation.finger}: {observation.field.reason or observation.field.status}"
            others = [one for one in self.problem.split("; ") if one and not one.startswith(observation.finger)]
            self.problem = "; ".join([*others, why])

    def take_reference(self, both: PairObservation) -> Armed | wire.Straighten | Refused | None:
        """Arm with this pair if both fingers are rearmed and readable; else store the problem and return None.

        Returns Refused if the gels or the gripper show that nothing is held, or that it hangs askew; Straighten where a
        tilt of the tool mends that.
        """
        if self.rearmed != {"left", "right"}:
            return None
        self.problem = both.unlike_grids()
        if self.problem:
            self.rearmed.clear()
            return None
        if why := nothing_held(both):
            return self.refusal("nothing_held", why)
        if why := implausible_width(self.arm):
            return self.refusal("implausible_width", why)
        if answer := self._upright(both):
            return answer
        self.reference, self.stage = both, Stage.ARMED
        self.ring.append(both)
        self.watched_ns = min(o.captured_ns for o in both.fingers)
        self.armed = Armed(**self.named, reference_seq=both.seq, frame_captured_ns=self.watched_ns)
        return self.armed

    def _upright(self, both: PairObservation) -> wire.Straighten | Refused | None:
        """What has to come before the descent of an object that is tilted in the hand, None if nothing."""
        if self.tilt.unknown and not self.inserts:
            return None
        self.tilt.lifted(both)
        if (tilt_deg := self.tilt.straightening()) is not None:
            self.stage = Stage.STRAIGHTENING
            return wire.Straighten(**self.named, tilt_deg=tilt_deg, detail=f"it is {self.tilt}")
        why = self.tilt.askew(both)
        return self.refusal("turned_in_hand", why) if why else None

    @property
    def named(self) -> dict[str, Any]:
        """The fields by which a message says that it is about this attempt."""
        return {"insertion_id": self.arm.insertion_id, "attempt": self.arm.attempt}

    def refusal(self, reason: wire.RefusalReason, detail: str) -> Refused:
        """The refusal to arm this attempt, which ends it."""
        self.stage, self.refused = Stage.DECIDED, Refused(**self.named, reason=reason, detail=detail)
        return self.refused

    def watching(self, observation: Observation, now_ns: int) -> Iterator[Watching]:
        """`watching`, if with this frame both fingers have been judged on newer frames than before.

        Its stamp is the older finger's: neither finger detects slip for the other.
        """
        if self.spoilt or not observation.informative:
            return
        self._informed_ns[observation.finger] = observation.certain_ns or observation.captured_ns
        oldest_ns = min(self._informed_ns.values())
        if len(self._informed_ns) == len(FINGERS) and oldest_ns > self.watched_ns:
            self.watched_ns = oldest_ns
            yield Watching(**self.named, frame_captured_ns=oldest_ns, judged_ns=now_ns)

    def take_in(self, both: PairObservation) -> None:
        """Add a pair after the reference; it may show the onset of motion."""
        self.ring.append(both)
        if self.reference is not None:
            self.pushes.append(push_of(both, self.reference))
        if self.onset_ns is not None:
            return
        onsets = [o.onset_ns for o in both.fingers]
        if self.onset_again:
            onsets = [watch.update(one.field) for watch, one in zip(self.onset_again, both.fingers, strict=True)]
        self.onset_ns = min((stamp_ns for stamp_ns in onsets if stamp_ns is not None), default=None)

    def dismisses(self, descent: Descent) -> bool:
        """Whether the detected onset was none, as when a heavy object sags; if so, wait for the next one."""
        if self.stage is not Stage.ARMED or self.spoilt or descent.problem or not descent.enough or descent.felt:
            return False
        self._await_onset()
        return True

    def _dismiss_early_onset(self) -> None:
        """What moved before the arm did is not the press, and its depth could not be known."""
        if self.onset_ns is not None and self.ring:
            self.fed, self.result = False, None
            self._await_onset()

    @property
    def paused_in_press(self) -> bool:
        """Whether the arm stood after the onset of motion, so that the depth of the pictures is not known."""
        onset_ns, paused_ns = self.onset_ns, self.legs.paused_ns
        return onset_ns is not None and paused_ns is not None and onset_ns < paused_ns

    def _await_onset(self) -> None:
        """Wait for the onset from the newest pair on, relative to its gel state, or the last that could be read."""
        pair = self.ring[-1]
        self.onset_again = tuple(OnsetDetector() for _ in pair.fingers)
        for finger, watch in enumerate(self.onset_again):
            shown = [one.fingers[finger].field for one in reversed(self.ring)]
            watch.rearm(next((field for field in shown if field.usable), shown[0]))
        self.ring = deque([pair], maxlen=RING_PAIRS)
        self.onset_ns = self.descent = self.run = None
        self.decision_pairs, self.steps = [], []

    def onset_index(self) -> int | None:
        """Index in the ring of the first pair at or after the onset, None while there is no onset."""
        if self.onset_ns is None:
            return None
        after = [max(o.captured_ns for o in pair.fingers) >= self.onset_ns for pair in self.ring]
        return after.index(True) if any(after) else None

    def take_decision_pairs(self, frames_n: int) -> list[PairObservation]:
        """The pairs that became part of the decision since the last call; sets the networks' reference at onset."""
        if len(self.decision_pairs) >= frames_n:
            return []
        if self.decision_pairs:
            fresh = [self.ring[-1]]
        else:
            index = self.onset_index()
            if index is None:
                return []
            fresh = list(self.ring)[index : index + frames_n]
            self.network_reference = fresh[0]
        self.decision_pairs += fresh
        return fresh

    def conditions(self) -> dict[str, float | None]:
        """The conditions of the attempt as stated by the client; see `model_card.CONDITIONS`."""
        arm = self.arm
        return {
            "gap_width_mm": arm.gap_width_mm,
            "grasp_height_mm": arm.grasp_height_mm,
            "grip_n": arm.grip_n,
            "shear_reach_mm": arm.shear_reach_mm,
            "speed_mm_s": self.speed_mm_s,
        }

    def descends(self, message: Descending, now_ns: int) -> None:
        """The arm descends, from now on at the stated speed, which it may change; or it goes on after a pause."""
        if message.paused_s:
            self.legs.pauses(now_ns, message.paused_s)
            return
        if self.descending_ns is None:
            self.descending_ns = now_ns
            self._dismiss_early_onset()
        self.speed_mm_s, self.start_mm, self.leg_ns = message.speed_mm_s, message.start_mm, now_ns
        self.legs.add(now_ns, message.speed_mm_s or 0.0)

    def ends(self, message: wire.Stopped) -> None:
        """The arm says where it stands, and what the gripper holds."""
        self.outcome, self.depth_mm = message.outcome, message.depth_mm
        self.gripper_width_mm = message.gripper_width_mm

    def stops(self, now_ns: int) -> None:
        """The arm is ordered to stop because of a frame captured at ``now_ns``."""
        self.slip_sent, self.stop_ns = True, now_ns

    def take_steps(self, card: ModelCard) -> list[NDArray[np.float32]]:
        """The steps of depth that the newest pair completes; the descent behind them begins at the onset."""
        pair, descent = self.ring[-1], self.descent
        if self.stop_ns is not None and min(one.captured_ns for one in pair.fingers) > self.stop_ns:
            return []  # the pair with the frame that stopped the arm is still read, its later half, too
        if descent is not None:
            self.decision_pairs.append(pair)
            fresh = descent.add(pair)
        else:
            index = self.onset_index()
            if index is None or self.onset_ns is None:
                return []
            pairs = list(self.ring)
            self.decision_pairs += pairs[index:]
            going_mm_s = self.speed_mm_s and self.legs.speed_mm_s(self.onset_ns)  # 0 in a pause
            conditions = self.conditions() | {"speed_mm_s": going_mm_s}
            self.descent = Descent(card, conditions, self.arm.press_mm, self.legs, self.arm.until_slip)
            fresh = self.descent.begin(pairs, index)
        self.steps += fresh
        return fresh
