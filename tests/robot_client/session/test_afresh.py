"""Regrasp: a turned object goes up and over to its fixture, and its attempts are counted together."""

import asyncio
import time
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import pytest

from robot_client.insertion.state import Phase, State
from robot_client.session.afresh import new_id, upright
from tests.robot_client.insertion.stories import APPROACH, PLAN


class Fixture:
    """Notes how the object was lifted."""

    def __init__(self):
        self.ups = []

    async def put_back(self, up):
        self.ups.append(up)


@pytest.mark.parametrize(
    ("reason", "attempt", "up", "attempts_n"),
    [
        ("service: refused: turned_in_hand: by about 1.4 deg", 3, "travel", 2 + 1),
        ("service: afresh: full depth was reached, but the gels show it turned", 3, "retract", 3 + 1),
        ("service: not_confirmed: full depth was reached, but the gels still carry a push", 3, None, 3),
    ],
)
def test_from_between_the_blocks_it_goes_up_slowly_and_what_was_tried_counts(reason, attempt, up, attempts_n):
    fixture, plans = Fixture(), []

    async def run(plan):
        plans.append(plan)
        state = replace(State(plan), armed=APPROACH)
        if len(plans) == 1:
            return replace(state, phase=Phase.FAILED, attempt=attempt, reason=reason)
        return replace(state, phase=Phase.INSERTED, attempt=1)

    state = asyncio.run(upright(PLAN, run, fixture, lambda _line: None))
    assert fixture.ups == ([up] if up else [])
    assert state.attempt == attempts_n
    assert [plan.continues for plan in plans[1:]] == ([PLAN.insertion_id] if up else [])


def test_an_insertion_is_named_by_the_same_clock_as_its_recording_wherever_the_plant_is(monkeypatch):
    monkeypatch.setenv("TZ", "JST-9")
    time.tzset()
    try:
        began = datetime.strptime(new_id()[:15], "%Y%m%d-%H%M%S").replace(tzinfo=UTC)
    finally:
        monkeypatch.undo()
        time.tzset()
    assert abs(datetime.now(UTC) - began) < timedelta(minutes=1)
