"""A descent in virtual time: a lease, the judged frames that renew it, and an arm that lags."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

from robot_client.insertion.events import Event, FromService, Hold, Renew, Tick
from robot_client.insertion.lease import ClockMap
from robot_client.insertion.limits import LimitError, Limits
from robot_client.insertion.machine import Phase, step
from robot_client.insertion.motion import CYCLE_S, MotionGuide
from robot_client.insertion.state import State
from service.contract import wire
from tests.hard_cases.rooms.links import MESSAGES, deciding

FRAME_S, ANSWERED_S, LAG_S = 1 / 30, 0.02, 0.02
FAULT_S, END_S = 0.7, 4.0
BOUND_MM = 1.5
ENDLESS = 1e9


@dataclass
class Descent:
    """Plays a descent; ``ticks``: whether the machine is asked for the time, ``keeps``: whether the last layer asks."""

    ticks: bool = True
    keeps: bool = True
    offset_s: float = 0.0  # the service's clock ahead of ours
    there_s: float = 0.001  # a message on its way to the service, and back
    back_s: float = 0.001
    guide: MotionGuide = field(init=False)
    state: State = field(init=False)

    def way_mm(self, heard: Callable[[float], list[Any]]) -> float:
        """The way after `FAULT_S`, the last judged frame; ``heard(now_s)`` is what the service says in a cycle."""
        self._begin()
        now_s, z_mm, at_fault_mm = 0.0, self.guide.target.z_mm, 0.0
        while now_s < END_S:
            now_s += CYCLE_S
            events: list[Event] = [FromService(at_s=now_s, message=message) for message in heard(now_s)]
            for event in (*events, *([Tick(at_s=now_s)] if self.ticks else [])):
                self._take(event)
            try:
                self.guide.advance(CYCLE_S, now_s if self.keeps else -ENDLESS)
            except LimitError:
                self.guide.hold()
            z_mm += (self.guide.target.z_mm - z_mm) * CYCLE_S / LAG_S
            if now_s <= FAULT_S:
                at_fault_mm = z_mm
        return at_fault_mm - z_mm

    def _begin(self) -> None:
        start = deciding().plan.approach
        trip_s = self.there_s + self.back_s
        clock = wire.Clock(sent_ns=round(-trip_s * 1e9), service_ns=round((self.offset_s - self.back_s) * 1e9))
        mapped = ClockMap.read(clock, 0.0)
        self.state = replace(
            deciding(), phase=Phase.ARMING, attempt=1, clock=mapped, deadline_s=3.0, watched_s=-ENDLESS
        )
        self.guide = MotionGuide(Limits(), self.state.plan.ramps, start)
        bottom = start.at_height(start.z_mm - 25.0)
        self._take(
            FromService(at_s=0.0, message=wire.Armed(**MESSAGES, reference_seq=1, frame_captured_ns=self.ns(0.0)))
        )
        assert self.state.phase is Phase.DESCENDING
        if not self.guide.moving:
            self.guide.move(bottom, "descend", self.state.until_s)

    def _take(self, event: Event) -> None:
        self.state, commands = step(self.state, event)
        for command in commands:
            if isinstance(command, Hold):
                self.guide.hold()
            elif isinstance(command, Renew):
                self.guide.renew(command.until_s)

    def ns(self, at_s: float) -> int:
        """A moment of ours as the service stamps it."""
        return round((at_s + self.offset_s) * 1e9)

    def watched(self, now_s: float, until_s: float = FAULT_S) -> list[Any]:
        """`watching` of frames captured up to ``until_s``, each when it has been judged and has come."""
        return [
            wire.Watching(**MESSAGES, frame_captured_ns=self.ns(shot_s), judged_ns=self.ns(shot_s + ANSWERED_S))
            for shot_s in shots(until_s)
            if shot_s + ANSWERED_S + self.back_s <= now_s < shot_s + ANSWERED_S + self.back_s + CYCLE_S - 1e-9
        ]


def shots(until_s: float) -> Iterator[float]:
    """Captures, the last one exactly at ``until_s``."""
    count = int(until_s / FRAME_S)
    return (until_s - FRAME_S * n for n in range(count, -1, -1))
