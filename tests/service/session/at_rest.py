"""A session over made-up fingers that see an object at rest: no picture, no network."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from service.contract import Finger, FramePair, TactileFrame, wire
from service.perception.observation import Observation
from service.session.state_machine import InsertionSession
from tests.service import tiny_models
from tests.service.decision.test_claim import PERIOD_NS, observation

ID = "test-1"
S = 10**9
PIXELS = np.zeros((2, 2, 3), np.uint8)


class Still:
    """A finger that sees an object at rest in every frame, until a test changes what it ``sees``."""

    gel_distance = None

    def __init__(self, finger: Finger) -> None:
        self.sees, self.problem, self.cause = observation(finger), "", ""
        self.learnt, self.tried, self.explained = list[int](), list[int](), list[int]()

    def rearm(self) -> None:
        """What it sees is its reference already."""

    def learn_open(self, frame: TactileFrame) -> str:
        self.tried.append(frame.seq)
        self.learnt += [] if self.problem else [frame.seq]
        return self.problem

    def explain(self, frame: TactileFrame) -> str:
        self.explained.append(frame.seq)
        return self.cause

    def forget_open(self) -> None:
        self.learnt.clear()

    def slips(self) -> None:
        slip = replace(self.sees.slip, state="gross_slip", score=1.0)
        self.sees = replace(self.sees, slip=slip)

    def observe(self, frame: TactileFrame) -> Observation:
        return replace(self.sees, seq=frame.seq, captured_ns=frame.captured_ns)


def at_rest() -> InsertionSession:
    """A session that was greeted, over two fingers at rest."""
    card = tiny_models.card("direction", "step")
    models: Any = SimpleNamespace(card=card, steps=[SimpleNamespace(card=card)], entries=())
    session = InsertionSession(models, Still("left"), Still("right"))
    session.handle(wire.ClientHello(insertion_id=ID, client="test"), 0)
    return session


def arm(session: InsertionSession, attempt: int = 1, at_ns: int = 0, **stated: Any) -> list[Any]:
    usual = {"gap_width_mm": 56.0, "expected_depth_mm": 25.0}
    return session.handle(wire.Arm(insertion_id=ID, attempt=attempt, **usual | stated), at_ns)


def shows(session: InsertionSession, index: int, from_ns: int = 0) -> list[Any]:
    at_ns = from_ns + index * PERIOD_NS
    pair = FramePair(*(TactileFrame(finger, index, at_ns, PIXELS) for finger in ("left", "right")))
    return [answer for answer in session.on_pair(pair, at_ns) if answer.type != "watching"]


def descends(session: InsertionSession, attempt: int = 1, at_ns: int = 0) -> list[Any]:
    return session.handle(wire.Descending(insertion_id=ID, attempt=attempt, speed_mm_s=10.0), at_ns)


def stops(session: InsertionSession, attempt: int = 1, at_ns: int = 0, **stated: Any) -> list[Any]:
    usual = {"depth_mm": 3.0, "outcome": "blocked"}
    return session.handle(wire.Stopped(insertion_id=ID, attempt=attempt, **usual | stated), at_ns)


def is_out_of_order(answers: list[Any]) -> bool:
    (fault,) = answers
    return (fault.type, fault.code, fault.fatal) == ("fault", "protocol", False)
