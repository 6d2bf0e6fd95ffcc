"""A camera whose pictures arrive later than the other's."""

from dataclasses import replace

import numpy as np
import pytest

from service.cameras.capture import Pairer
from service.contract import FINGERS, TactileFrame, wire
from service.perception.observation import Observation
from service.session.state_machine import InsertionSession
from tests.service.decision.test_claim import PERIOD_NS
from tests.service.session.at_rest import ID, PIXELS, Still, arm, at_rest


class Tracked(Still):
    """A finger that takes a frame for a repeated one unless it is newer than all before, as a tracker does."""

    newest_ns = -1

    def observe(self, frame: TactileFrame) -> Observation:
        shown, newer = super().observe(frame), frame.captured_ns > self.newest_ns
        self.newest_ns = max(self.newest_ns, frame.captured_ns)
        return shown if newer else replace(shown, field=replace(shown.field, status="duplicate"))


@pytest.mark.parametrize("late_periods", [0, 3])
def test_a_camera_whose_pictures_arrive_periods_later_is_armed_and_read_in_pairs_of_one_moment(
    late_periods: int,
) -> None:
    greeted = at_rest()
    session, pairer = InsertionSession(greeted.models, *map(Tracked, FINGERS)), Pairer()
    session.handle(wire.ClientHello(insertion_id=ID, client="test"), 0)
    arm(session)
    frames = [TactileFrame(finger, seq, seq * PERIOD_NS, PIXELS) for seq in range(12) for finger in FINGERS]
    frames.sort(key=lambda one: one.seq + late_periods * (one.finger == "right"))
    answers = []
    for one in frames:
        pair = pairer.add(one)
        answers += session.on_frame(one, one.captured_ns)
        answers += session.on_pair(pair, one.captured_ns) if pair else []
    assert [answer.type for answer in answers] == ["armed"] + ["watching"] * 11
    assert session.attempt is not None
    assert [(pair.left.seq, pair.right.seq) for pair in session.attempt.ring][1:] == [(k, k) for k in range(1, 12)]
    assert np.isfinite([push.weaker_pitch for push in session.attempt.pushes]).all()
