"""The same story gives the same orders, at the same places and times, as it did: stop, lease, way, speed, sign."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from robot_client.insertion.events import Arrived, Begin, Event, Grasped, Hold, Move, Renew, Send, Standstill, Tick
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.lease import PAUSE_S
from robot_client.insertion.limits import Limits
from robot_client.insertion.machine import Plan, State, step
from robot_client.insertion.motion import CYCLE_S, MotionGuide, Ramps
from robot_client.insertion.pace import Pace
from robot_client.insertion.profile import plan_legs, plan_profile
from robot_client.insertion.seconds import Seconds
from service.contract import wire
from tests.kept import is_as_kept
from tests.robot_client.insertion.stories import (
    ID,
    LIMITS,
    armed,
    correction,
    hello,
    no_decision,
    service,
    slip,
    watching,
)

START = WorkPose(x_mm=-4.0, y_mm=1.0, z_mm=60.0, yaw_deg=-3.0)
APPROACH = WorkPose(x_mm=7.0, y_mm=0.5, z_mm=35.0, yaw_deg=5.0)
CAMERAS = tuple(wire.CameraEntry(finger=f, source="s", state="live", frame_rate_hz=30.0) for f in ("left", "right"))
PLANS = {
    "as it ships": {"pace": Pace(), "pause_s": PAUSE_S, "creep_allowance_mm": 2.0},
    "at one speed": {"fixture": True, "limits": Limits(max_attempts=3)},
    "a probe": {"purpose": "probe", "pace": Pace(fast_mm_s=12.0), "pause_s": PAUSE_S},
}
STOPS_MM = [6.4, 7.9, 25.0]  # depth at which each attempt is stopped
PERIOD_S, LATE_S = 0.033, 0.012


class Cell:
    """An arm that lags behind its targets, and a service that sees it blocked at the depths of STOPS_MM."""

    def __init__(self, plan: Plan) -> None:
        self.state, self.seconds, self.orders = State(plan), Seconds(), list[Any]()
        self.guide = MotionGuide(plan.limits, plan.ramps, START)
        self.here, self.now_s, self.judged_s, self.way = START, 100.0, 100.0, list[Any]()

    def happens(self, event: Event) -> None:
        self.state, commands = step(self.state, event)
        self.seconds.on_event(self.state, event)
        for command in commands:
            left_s = min(self.state.deadline_s - self.now_s, 1e9)
            self.orders.append([self.now_s, self.state.phase.value, left_s, *ordered(command)])
            match command:
                case Move():
                    self.guide.move(command.target, command.motion, command.until_s, command.legs)
                case Renew():
                    self.guide.renew(command.until_s)
                case Hold():
                    self.guide.hold()
                case Send():
                    for message in self.answers(command.message):
                        self.happens(service(message, self.now_s))

    def answers(self, message: Any) -> Iterator[Any]:
        attempt = self.state.attempt
        match message:
            case wire.ClientHello():
                clock = wire.Clock(sent_ns=message.sent_ns, service_ns=message.sent_ns + 5_000_000)
                yield hello(cameras=CAMERAS, clock=clock, limits=LIMITS)
            case wire.LearnOpen():
                yield wire.OpenLearnt(insertion_id=ID)
            case wire.Arm():
                yield armed(attempt, at_s=self.now_s - LATE_S + 0.005)
            case wire.Stopped(outcome="blocked"):
                yield correction(attempt, -4.2, 2.5) if attempt != 2 else no_decision(attempt)
            case wire.Stopped(outcome="inserted"):
                yield wire.Finished(insertion_id=ID, outcome="inserted", attempts=attempt)

    def cycle(self) -> None:
        self.now_s += CYCLE_S
        target = self.guide.advance(CYCLE_S, self.now_s)
        self.here = self.here.towards(target, 0.15)
        self.way.append([target.x_mm, target.z_mm, target.yaw_deg])
        if settled := self.guide.observe(self.here, self.now_s):
            stood = Standstill(at_s=self.now_s, pose=self.here, still_s=0.04)
            self.happens(Arrived(at_s=self.now_s, pose=self.here) if settled == "arrived" else stood)
        if self.state.phase.value == "descending" and self.now_s - self.judged_s >= PERIOD_S:
            self.judged_s = self.now_s + (0.3 if 8.0 < APPROACH.z_mm - self.here.z_mm < 8.3 else 0.0)  # once it blinks
            stamp_s = self.now_s - LATE_S + 0.005
            self.happens(service(watching(self.state.attempt, stamp_s), self.now_s))
            stop_mm = STOPS_MM[min(self.state.attempt, 3) - 1]
            if APPROACH.z_mm - self.here.z_mm >= stop_mm and self.state.phase.value == "descending":
                self.happens(service(slip(self.state.attempt), self.now_s))
        self.happens(Tick(at_s=self.now_s))


def ordered(command: Any) -> list[Any]:
    """What is kept of a command."""
    content = command.model_dump(mode="json")
    message = content.pop("message", None)
    dumped = content if message is None else message
    return [f"{key}={dumped[key]}" if isinstance(dumped[key], str) else [key, dumped[key]] for key in sorted(dumped)]


@pytest.mark.parametrize("name", PLANS)
def test_an_insertion_is_ordered_as_it_was(name: str) -> None:
    plan = Plan(insertion_id=ID, approach=APPROACH, gap_width_mm=56.0, expected_depth_mm=25.0, **PLANS[name])
    cell = Cell(plan)
    cell.happens(Begin(at_s=cell.now_s, pose=START))
    cell.happens(Grasped(at_s=cell.now_s, width_mm=50.0))
    for _ in range(20_000):
        cell.cycle()
        if cell.state.done:
            break
    again = cell.state.afresh("second")
    rest = [cell.state.reason, cell.seconds.spent, None if again is None else again.model_dump(mode="json")]
    is_as_kept(__file__, f"insertion: {name}", [cell.orders, cell.way[::25], rest])


def test_ways_are_walked_as_they_were() -> None:
    """Long, short and shorter than a ramp; and legs, one of them too short for its speed."""
    profiles = [plan_profile(length, 25.0, 200.0, 4000.0) for length in (0.01, 0.3, 2.0, 30.0)]
    profiles += [plan_profile(length, 2.0, 200.0, 400.0) for length in (0.05, 5.0)]
    legs = [[(3.0, 10.0), (6.0, 5.0), (16.0, 10.0)], [(0.2, 20.0), (5.0, 8.0), (0.05, 1.0)], [(0.02, 9.0)]]
    profiles += [plan_legs(ways, 100.0, 2000.0) for ways in legs]
    ways = [[one.position(share * one.duration_s) for share in np.linspace(0, 1, 17)] for one in profiles]
    speeds = [one.speeds() for one in profiles[-len(legs) :]]
    is_as_kept(__file__, "ways", [[one.duration_s for one in profiles], ways, speeds])


def test_gaps_in_the_stream_and_turns_are_walked_as_they_were() -> None:
    guide = MotionGuide(Limits(), Ramps(), START)
    guide.move(START.model_copy(update={"x_mm": 9.0, "yaw_deg": 30.0}), "travel")
    rhythm = [4, 4, 8, 4, 40, 4, 12, 13, 15, 4] * 40
    way = [guide.advance(cycle_ms * 1e-3, 0.0) for cycle_ms in rhythm]
    is_as_kept(__file__, "gaps", [[pose.x_mm, pose.yaw_deg] for pose in way[::5]])


def test_what_ships_stays() -> None:
    """Limits, ramps, times, lease and pace of a plan that says nothing of them."""
    plan = Plan(insertion_id=ID, approach=APPROACH, gap_width_mm=56.0, expected_depth_mm=25.0)
    is_as_kept(__file__, "shipped", [plan.model_dump(mode="json"), Pace().model_dump(mode="json")])
