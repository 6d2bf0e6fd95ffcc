"""The same messages and pictures give the same answers as they did, in number, order, stamp and figure."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from service.contract import FramePair, TactileFrame, wire
from service.decision.models import ModelSet
from service.session.factory import make_session
from service.session.fingers import gels_of
from service.session.state_machine import InsertionSession
from tests.kept import is_as_kept
from tests.service import drawn

ID = "kept"
AT_REST = 10**6
MS = 1_000_000
LEFT_OUT = {"insertion_id", "latency_ms", "models", "cameras", "protocol", "type"}


def open_pair(seq: int, stamp_ns: int) -> FramePair:
    return FramePair(*(TactileFrame(finger, seq, stamp_ns, drawn.untouched(finger)) for finger in ("left", "right")))


class Talk:
    """A client and two cameras at 30 frames a second; ``heard`` is what the session answers."""

    def __init__(self, models: ModelSet) -> None:
        self.session = make_session(models, drawn.calibration())
        self.now_ns, self.heard = 0, list[Any]()

    def says(self, kind: type, **content: Any) -> None:
        self.take(self.session.handle(kind(insertion_id=ID, **content), self.now_ns))

    def arms(self, attempt: int, **content: Any) -> None:
        usual = {"gap_width_mm": 56.0, "expected_depth_mm": 25.0, "gripper_width_mm": 50.0}
        self.says(wire.Arm, attempt=attempt, **usual | content)

    def shows(self, first: int, last: int, onset: int = AT_REST, slip_at: int = AT_REST) -> Iterator[int]:
        """Each pair of an attempt, taken at once."""
        begun_ns = self.now_ns - first * drawn.PERIOD_NS
        for index in range(first, last):
            pair = drawn.pair(index, onset=onset, slip_at=slip_at, start_ns=begun_ns)
            self.now_ns = pair.captured_ns
            self.take(self.session.on_pair(pair, self.now_ns + 4 * MS))
            self.take(self.session.on_tick(self.now_ns + 5 * MS))
            yield index
        self.now_ns += drawn.PERIOD_NS

    def waits(self, wait_s: float) -> None:
        for _ in range(round(wait_s * 20)):
            self.now_ns += 50 * MS
            self.take(self.session.on_tick(self.now_ns))

    def take(self, messages: list[wire.ServiceMessage]) -> None:
        for message in messages:
            content = message.model_dump(mode="json", exclude=LEFT_OUT)
            self.heard.append([self.now_ns // MS, message.type, content])

    def presses(self, attempt: int, onset: int = 8, slip_at: int = 14, **stopped: Any) -> None:
        """An attempt that is stopped two frames after slip."""
        self.arms(attempt)
        for index in self.shows(0, slip_at + 6, onset, slip_at):
            if index == 1:
                self.says(wire.Descending, attempt=attempt, speed_mm_s=6.0)
            if index == slip_at + 3:
                self.says(wire.Stopped, attempt=attempt, **{"depth_mm": 3.0, "outcome": "blocked"} | stopped)
        self.waits(2.5)

    def goes_in(self, attempt: int, depth_mm: float = 6.0, **stopped: Any) -> None:
        self.arms(attempt, expected_depth_mm=6.0)
        for index in self.shows(0, 30):
            if index == 1:
                self.says(wire.Descending, attempt=attempt, speed_mm_s=6.0)
        self.says(
            wire.Stopped, attempt=attempt, depth_mm=depth_mm, outcome="inserted", gripper_width_mm=50.0, **stopped
        )


def blocked_twice_and_in(talk: Talk) -> None:
    talk.presses(1)
    talk.presses(2, onset=12, slip_at=20)
    talk.goes_in(3)


def learnt_open(talk: Talk) -> None:
    talk.says(wire.LearnOpen)
    talk.take(talk.session.on_pair(open_pair(0, talk.now_ns), talk.now_ns))
    talk.now_ns += drawn.PERIOD_NS
    talk.goes_in(1)


def falls_out(talk: Talk) -> None:
    learnt = open_pair(0, talk.now_ns)
    talk.says(wire.LearnOpen)
    talk.take(talk.session.on_pair(learnt, talk.now_ns))
    talk.now_ns += drawn.PERIOD_NS
    talk.arms(1)
    for _ in talk.shows(0, 6):
        pass
    for seq in range(6, 10):
        talk.now_ns += drawn.PERIOD_NS
        talk.take(talk.session.on_pair(open_pair(seq, talk.now_ns), talk.now_ns))


def trouble(talk: Talk) -> None:
    talk.arms(1)
    talk.waits(2.2)
    talk.arms(2)
    for _ in talk.shows(0, 4):
        pass
    talk.take(talk.session.on_camera_fault("camera_lost", "left is gone"))
    talk.says(wire.Stopped, attempt=2, depth_mm=1.0, outcome="blocked")
    talk.arms(3)
    for _ in talk.shows(0, 4):
        pass
    talk.waits(0.7)
    talk.says(wire.ClientHeartbeat, count=3, sent_ns=7)
    talk.says(wire.Stopped, attempt=3, depth_mm=1.0, outcome="dropped")
    talk.says(wire.Arm, attempt=4, gap_width_mm=56.0, expected_depth_mm=25.0)


def never_moves(talk: Talk) -> None:
    talk.arms(1, gripper_width_mm=1.5)
    for _ in talk.shows(0, 2):
        pass
    talk.arms(2)
    for _ in talk.shows(0, 5):
        pass
    talk.says(wire.Descending, attempt=2)
    talk.says(wire.Stopped, attempt=2, depth_mm=2.0, outcome="blocked", still_s=0.1)
    talk.waits(2.3)
    talk.says(wire.Abort, cause="operator", reason="enough")


STORIES: dict[str, Callable[[Talk], None]] = {
    story.__name__: story for story in (blocked_twice_and_in, learnt_open, falls_out, trouble, never_moves)
}


@pytest.mark.parametrize("name", STORIES)
def test_a_session_answers_as_it_did(name: str, models: ModelSet) -> None:
    talk = Talk(models)
    talk.says(wire.ClientHello, client="test", takes_afresh=True, controller="heuristic" if name == "trouble" else None)
    STORIES[name](talk)
    session: InsertionSession = talk.session
    gels = gels_of((session.left, session.right), session.attempt)
    is_as_kept(__file__, name, [talk.heard, gels])
