"""How late pictures and arm are together: what presses at two speeds in one grasp tell, and what an insertion does."""

import asyncio

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_client.cli.check import findings_of
from robot_client.cli.insert import with_commissioning
from robot_client.insertion.events import Standstill
from robot_client.insertion.lease import Lease
from robot_client.insertion.limits import LimitError
from robot_client.insertion.state import State
from robot_client.session.commission.lateness import FAST, PLACE, goes_on, late_s, slow_and_fast
from robot_client.session.commission.record import Record, keep_record, read_record
from robot_client.session.commission.wiring import SIDES
from robot_client.session.stops import Stop, StopWatch
from robot_client.settings import Settings
from service.contract import wire
from tests.robot_client.insertion.stories import APPROACH, ID, PLAN, TO_DESCENT, at, run, service
from tests.robot_client.session.test_commission import Cell, commissioning
from tests.robot_client.session.test_wiring import answers

AGE_S = st.floats(0.0, 0.1)
AGES_S = (0.02,) * len(FAST)


def stops(late, *, touch_mm=6.0, crept_mm=0.0, ages_s=AGES_S, speeds=(4.0, 10.0), fast_too_mm=0.0):
    """Stops in a cell that is ``late`` s; a slow press pushes the object up by ``crept_mm``, a fast one by more."""
    made = []
    for number, (fast, age_s) in enumerate(zip(FAST, ages_s, strict=True)):
        speed, pressed_mm = speeds[fast], 0.75 + 0.01 * number
        depth_mm = touch_mm + speed * (late + age_s) + pressed_mm
        made.append(Stop(speed_mm_s=speed, depth_mm=depth_mm, waited_s=age_s, pressed_mm=pressed_mm))
        touch_mm += crept_mm + (fast_too_mm if fast else 0.0)
    return made


@given(st.floats(0.0, 0.3), st.floats(0.0, 0.2), st.floats(0.0, 1.0), st.lists(AGE_S, min_size=6, max_size=6))
def test_the_lateness_is_told_however_the_object_creeps_and_however_long_the_service_took(late, crept, more, ages):
    made = stops(late, crept_mm=crept, fast_too_mm=more, ages_s=ages)
    assert late_s(made) == pytest.approx(late, abs=1e-6)


def test_the_larger_of_both_values_counts_and_none_is_negative():
    made = stops(0.05)
    later = made[-1].model_copy(update={"depth_mm": made[-1].depth_mm + 0.12})
    assert late_s([*made[:-1], later]) == pytest.approx(0.07)
    assert late_s(stops(-0.05)) == 0.0
    assert late_s(made[:-1]) == pytest.approx(0.05), "one fast press will do"
    assert late_s(made[:2]) is late_s([]) is None


def test_an_object_that_slides_in_the_hand_is_pressed_fast_once():
    firm, slides = stops(0.05, crept_mm=0.1), stops(0.05, crept_mm=0.8)
    assert [goes_on(firm[:number]) for number in range(7)] == [True] * 6 + [False]
    assert [goes_on(slides[:number]) for number in range(4)] == [True] * 3 + [False]
    assert late_s(slides[:3]) == pytest.approx(0.05)


def test_a_press_is_kept_with_its_speed_its_age_and_where_the_arm_stood():
    enough = wire.Enough(insertion_id=ID, attempt=1, frame_seq=3, captured_ns=30_000_000, pressed_mm=0.8)
    still = APPROACH.at_height(APPROACH.z_mm - 7.5)
    watch, state = StopWatch(), State(PLAN.model_copy(update={"purpose": "timing"}))
    for event in [*TO_DESCENT, service(enough, 0.05), at(still, Standstill)]:
        state, _ = run([event], state)
        watch.on_event(state, event)
    assert watch.stop.speed_mm_s == 10.0
    assert watch.stop.waited_s == pytest.approx(0.02, abs=1e-3)
    assert (watch.stop.pressed_mm, watch.stop.depth_mm) == (0.8, 7.5)
    assert watch.stop.past_contact_mm(0.05) == pytest.approx(0.8 + 10.0 * 0.07, abs=0.01)


@pytest.mark.parametrize(("rate_hz", "fast"), [(60.0, 10.0), (15.0, 9.375)])
def test_the_fast_press_is_as_fast_as_cameras_and_limits_allow(rate_hz, fast):
    legs = PLAN.model_copy(update={"pace": PLAN.pace.model_copy(update={"fast_mm_s": 20.0})})
    slow, quick = slow_and_fast(legs, rate_hz)
    assert [plan.ramps.descend.speed_mm_s for plan in (slow, quick)] == [4.0, pytest.approx(fast)]
    assert {plan.pace.fast_mm_s for plan in (slow, quick)} == {None}
    assert {plan.purpose for plan in (slow, quick)} == {"timing"}, "nothing is learnt from them"
    narrow = PLAN.model_copy(update={"limits": PLAN.limits.model_copy(update={"max_descent_speed_mm_s": 5.0})})
    with pytest.raises(LimitError, match="do not tell how late"):
        slow_and_fast(narrow, rate_hz)


class Pressed(Cell):
    """A cell in which each press stops as it would with a lateness of 0.08 s; ``blind_at`` is one that does not."""

    def __init__(self, blind_at=0, **how):
        super().__init__(**how)
        self.presses, self.blind_at = [], blind_at

    async def press_at(self, x_mm, theta_deg, fast):
        number = len(self.presses) % (1 + len(FAST)) - 1
        self.presses.append((x_mm, theta_deg, fast, self.fetched_n))
        ended = await self.probe(x_mm, theta_deg)
        return ended._replace(stop=None if number + 1 in {0, self.blind_at} else stops(0.08)[number])


def timed(cell, path, record=None):
    running = commissioning(cell, path, record)
    running.press_at = cell.press_at
    return asyncio.run(running.run(6))


def test_the_presses_follow_the_signs_once_and_in_one_grasp(tmp_path):
    cell, path = Pressed(), tmp_path / "record.json"
    record = timed(cell, path)
    again = timed(cell, path, read_record(path))
    assert record.late_s == again.late_s == pytest.approx(0.08)
    assert cell.presses == [(*PLACE, fast, len(SIDES) + 1) for fast in (False, *FAST)]
    assert record.model_copy(update={"stops": ()}).digest() != record.digest()


def test_a_series_with_a_press_that_did_not_stop_is_not_kept_and_tried_again(tmp_path):
    cell, path = Pressed(blind_at=2), tmp_path / "record.json"
    record = timed(cell, path)
    assert (record.stops, record.late_s, len(record.probes)) == ((), None, 2)
    assert len(cell.presses) == 3
    cell.blind_at, cell.presses = 0, []
    assert timed(cell, path, read_record(path)).late_s == pytest.approx(0.08)


def test_a_cell_with_the_wrong_signs_is_not_timed(tmp_path):
    cell = Pressed(sign=-1)
    timed(cell, tmp_path / "record.json")
    assert cell.presses == []


@pytest.mark.parametrize(("late", "set_s", "counts_s"), [(0.09, 0.04, 0.09), (0.03, 0.04, 0.04), (None, 0.05, 0.05)])
def test_an_insertion_reckons_with_the_lateness_of_its_commissioning_where_that_is_longer(
    tmp_path, late, set_s, counts_s
):
    path = tmp_path / "commissioning.json"
    made = stops(late) if late else ()
    keep_record(path, Record(begun="today", seed=1, signs=tuple(answers()), stops=tuple(made)))
    plan = PLAN.model_copy(update={"lease": Lease(stop_lag_s=set_s)})
    timed_plan = with_commissioning(Settings(commissioning=path), plan, asked=True)
    assert timed_plan.lease.stop_lag_s == pytest.approx(counts_s)


@pytest.mark.parametrize(
    ("late", "good", "says"),
    [
        (None, True, "not measured: for 40 ms the lease lasts 260 ms"),
        (0.09, True, "late by 90 ms: the lease lasts 210 ms"),
        (0.29, False, "descend more slowly than 4.8 mm/s"),
    ],
)
def test_check_tells_how_late_the_cell_is_and_refuses_one_that_is_too_late(tmp_path, late, good, says):
    path = tmp_path / "commissioning.json"
    keep_record(path, Record(begun="today", seed=1, signs=tuple(answers()), stops=tuple(stops(late)) if late else ()))
    real = Settings(commissioning=path)

    async def cell():
        return [finding async for name, finding in findings_of(real) if name == "cell"]

    (finding,) = asyncio.run(cell())
    assert finding.good == good
    assert says in finding.text


def test_a_lateness_that_uses_up_the_lease_is_refused_with_the_speed_that_would_do():
    late = PLAN.model_copy(update={"lease": PLAN.lease.late_by(0.14)})
    with pytest.raises(LimitError, match=r"140 ms of stop lag at 10 mm/s; descend more slowly than 9.4 mm/s"):
        late.check()
    late.at_speed(9.0).check()
