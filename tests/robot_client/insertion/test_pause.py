"""A descent whose pictures cease, by a client and by a service as they ship."""

from pathlib import Path

import pytest

from robot_client.insertion.events import Move, Renew, Tick
from robot_client.insertion.lease import PAUSE_S
from robot_client.insertion.machine import Phase, State, step
from service.contract import FramePair, TactileFrame, wire
from service.session.state_machine import InsertionSession
from service.session.station import TICK_S
from service.settings import Settings
from tests.robot_client.insertion.stories import ID, PLAN, TO_DESCENT, run, service
from tests.service.session.at_rest import PIXELS, Still, at_rest

STEP_S = 0.001
HANDLING_S = 0.02  # from a picture to its message


def shipped_session() -> InsertionSession:
    """One that was greeted and armed, under the limits of a service that is given nothing but its cameras."""
    limits = Settings(camera_left="push:", camera_right="push:", models=Path("models")).limits
    session = InsertionSession(at_rest().models, Still("left"), Still("right"), limits=limits)
    session.handle(wire.ClientHello(insertion_id=ID, client="test"), 0)
    session.handle(wire.Arm(insertion_id=ID, attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0), 0)
    shown(session, 0, 0.0, 0.0)
    session.handle(wire.Descending(insertion_id=ID, attempt=1, speed_mm_s=PLAN.ramps.descend.speed_mm_s), 0)
    return session


def shown(session: InsertionSession, seq: int, captured_s: float, now_s: float) -> list:
    frames = (TactileFrame(finger, seq, round(captured_s * 1e9), PIXELS) for finger in ("left", "right"))
    return session.on_pair(FramePair(*frames), round(now_s * 1e9))


class Descent:
    """Client and service on one clock, a descent under way since 0 s, pictures as the test captures them."""

    def __init__(self, speed_mm_s: float = 10.0) -> None:
        self.session = shipped_session()
        plan = PLAN.at_speed(speed_mm_s).model_copy(update={"pause_s": PAUSE_S})
        self.state, commands = run(TO_DESCENT, State(plan))
        (move,) = [one for one in commands if isinstance(one, Move) and one.motion == "descend"]
        self.until_s, self.pauses_n, self.faults = move.until_s, 0, []

    def runs(self, captures_s: list[float], end_s: float) -> None:
        """Until the client holds, or until ``end_s``."""
        seq = tick_n = 0
        for now_s in (STEP_S * n for n in range(1, round(end_s / STEP_S))):
            answers = []
            while captures_s[seq:] and captures_s[seq] + HANDLING_S <= now_s:
                answers += shown(self.session, seq + 1, captures_s[seq], now_s)
                seq += 1
            if now_s >= (tick_n + 1) * TICK_S:
                tick_n += 1
                answers += self.session.on_tick(round(now_s * 1e9))
            self.faults += [one for one in answers if one.type == "fault"]
            for event in (Tick(at_s=now_s), *(service(one, now_s) for one in answers)):
                self.state, commands = step(self.state, event)
                for renewed in (one for one in commands if isinstance(one, Renew)):
                    self.pauses_n += self.until_s < now_s
                    self.until_s = renewed.until_s
            if self.state.phase is not Phase.DESCENDING:
                return


def at_rate(rate_hz: float, from_s: float, until_s: float) -> list[float]:
    return [from_s + n / rate_hz for n in range(round((until_s - from_s) * rate_hz))]


@pytest.mark.parametrize("speed_mm_s", [5.0, 10.0])
def test_a_descent_stands_while_pictures_are_missing_and_goes_on_with_the_next(speed_mm_s: float) -> None:
    descent = Descent(speed_mm_s)
    descent.runs(at_rate(30.0, 0.0, 0.3) + at_rate(30.0, 0.5, 0.8), 0.8)
    assert (descent.state.phase, descent.faults) == (Phase.DESCENDING, []), descent.state.reason
    assert descent.pauses_n == (1 if speed_mm_s == 10.0 else 0), "at half the speed the lease outlasts the gap"


def test_pictures_that_come_no_more_end_a_descent_by_its_lease_before_the_service_calls_them_stale() -> None:
    descent = Descent()
    descent.runs(at_rate(30.0, 0.0, 0.3), 2.0)
    assert descent.state.phase is Phase.FAILED
    assert "unwatched" in descent.state.reason
    assert descent.faults == []


def test_the_slowest_cameras_that_a_client_accepts_are_fast_enough_for_the_service() -> None:
    rate_hz = 6.3
    assert PLAN.lease.fastest_mm_s(rate_hz) > 5.0
    descent = Descent(5.0)
    descent.runs(at_rate(rate_hz, 0.0, 2.0), 2.0)
    assert (descent.state.phase, descent.pauses_n, descent.faults) == (Phase.DESCENDING, 0, []), descent.state.reason
