"""The open gels: both fingers before a grasp, learnt from the first frames after the client's request."""

from collections.abc import Iterable
from dataclasses import dataclass, field

from service.contract import FINGERS, Finger, TactileFrame, wire
from service.decision.attempt import Attempt
from service.decision.held_tilt import UNSEEN
from service.perception.observation import FingerWatch

STARTED = "the service was started anew, and has not seen the hand open"


@dataclass(slots=True)
class OpenGels:
    """Learns each finger's open gel once per request.

    ``held_over``: why it is not known how an object hangs in a hand that is not open first, or "".
    """

    held_over: str = ""
    _asked_ns: int | None = None
    _learnt: set[Finger] = field(default_factory=set)
    _refused: dict[Finger, tuple[str, FingerWatch, TactileFrame]] = field(default_factory=dict)
    _tried_ns: dict[Finger, int] = field(default_factory=dict)
    _opened: bool = False

    @property
    def unknown(self) -> str:
        """Why it is not known how the object hangs, or "": the hand was open before it was grasped."""
        return "" if len(self._learnt) == len(FINGERS) else self.held_over

    def grasped_anew(self) -> bool:
        """Whether the hand was open since this was asked last."""
        opened, self._opened = self._opened, False
        return opened

    def after(self, attempt: Attempt | None) -> str:
        """What an ended insertion holds over to the next one; ``attempt`` is its last.

        However it ended: a confirmed object may stay in the hand, as may one that the gripper says it has lost.
        """
        if attempt is None:
            return self.unknown
        # one that is armed again has not gone down yet, but before: its tilt knows
        went_down = attempt.arm.attempt > 1 or attempt.descending_ns is not None
        return UNSEEN if went_down else attempt.tilt.unknown or self.unknown

    @property
    def waiting(self) -> bool:
        """Whether frames are still needed."""
        return self._asked_ns is not None

    def ask(self, message: wire.LearnOpen, fingers: Iterable[FingerWatch], now_ns: int) -> None:
        """Learn from frames captured from now on, or forget what was learnt."""
        self._asked_ns = None if message.forget else now_ns
        self._refused.clear()
        self._learnt.clear()
        self._tried_ns.clear()
        self._opened = False
        for watch in fingers if message.forget else ():
            watch.forget_open()

    def take(self, insertion_id: str, watch: FingerWatch, frame: TactileFrame) -> list[wire.ServiceMessage]:
        """Learn from a frame; the answer once both fingers are learnt."""
        since_ns = max(self._asked_ns or 0, self._tried_ns.get(frame.finger, -1) + 1)
        if self._asked_ns is None or frame.captured_ns < since_ns or frame.finger in self._learnt:
            return []
        self._tried_ns[frame.finger] = frame.captured_ns  # a frame comes alone and in its pair
        self._refused.pop(frame.finger, None)
        if problem := watch.learn_open(frame):
            self._refused[frame.finger] = problem, watch, frame
            return []
        self._learnt.add(frame.finger)
        if len(self._learnt) < len(FINGERS):
            return []
        self._asked_ns, self._opened = None, True
        return [wire.OpenLearnt(insertion_id=insertion_id)]

    def overdue(self, insertion_id: str, now_ns: int, allowed_s: float) -> list[wire.ServiceMessage]:
        """The fault once the frames have taken too long."""
        if self._asked_ns is None or now_ns - self._asked_ns <= allowed_s * 1e9:
            return []
        self._asked_ns = None
        if absent := " and ".join(finger for finger in FINGERS if finger not in self._tried_ns):
            return [self._unlearnt(insertion_id, "camera_stalled", f"no frame of the {absent} finger arrived")]
        finger, (problem, watch, frame) = self._refused.popitem()
        cause = watch.explain(frame)  # only now: for each frame, it would keep messages waiting
        why = ": ".join(filter(None, (f"{finger} finger", problem, cause)))
        return [self._unlearnt(insertion_id, "open_gel", why)]

    @staticmethod
    def _unlearnt(insertion_id: str, code: wire.FaultCode, why: str) -> wire.Fault:
        detail = f"the open gels could not be learnt: {why}"
        return wire.Fault(insertion_id=insertion_id, code=code, detail=detail, fatal=False)
