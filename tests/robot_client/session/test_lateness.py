"""How late pictures and arm are together: what presses at two speeds tell."""

import asyncio

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_client.insertion.events import Standstill, Stood
from robot_client.insertion.limits import LimitError
from robot_client.insertion.state import REFUSED, Phase, State
from robot_client.ports import DriverError
from robot_client.session.commission.lateness import MOST_N, PLACE, Press, late_s, next_is_fast, slow_and_fast
from robot_client.session.commission.record import read_record
from robot_client.session.commission.run import GRASPS_N, Ended
from robot_client.session.commission.wiring import SIDES
from robot_client.session.stops import Stop, StopWatch
from service.contract import wire
from tests.robot_client.insertion.stories import APPROACH, ID, PLAN, TO_DESCENT, at, run, service, slip, watching
from tests.robot_client.session.test_commission import Cell, commissioning

ORDER = (False, False, False, True, False, False, True)
"""Which presses of a series are fast, if none ends by slip."""
FRAME_S = 0.08


def pressed(fast, touch_mm, late, *, age_s=0.02, pressed_mm=0.75, speeds=(4.0, 10.0), frame_s=FRAME_S):
    """A press that touched at that depth, in a cell that is ``late`` s."""
    depth_mm = touch_mm + speeds[fast] * (late + age_s) + pressed_mm
    stop = Stop(speed_mm_s=speeds[fast], depth_mm=depth_mm, waited_s=age_s, pressed_mm=pressed_mm, frame_s=frame_s)
    return Press(fast=fast, stop=stop)


def series_of(late, *, crept_mm=0.0, fast_too_mm=0.0, ages_s=(0.02,), slips=(), **how):
    """A whole series; each press moves the object, a fast one by more. ``slips``: numbers of presses that slip ends."""
    made, touch_mm = [], 6.0
    while (fast := next_is_fast(made)) is not None:
        press = pressed(fast, touch_mm, late, age_s=ages_s[len(made) % len(ages_s)], **how)
        made.append(Press(fast=fast, stop=None) if len(made) in slips else press)
        touch_mm += crept_mm + (fast_too_mm if fast else 0.0)
    return made


@given(
    late=st.floats(0.0, 0.3),
    crept_mm=st.floats(0.0, 0.29),
    fast_too_mm=st.floats(0.0, 1.0),
    ages_s=st.lists(st.floats(0.0, 0.1), min_size=1, max_size=7),
    slips=st.sets(st.integers(0, 11), max_size=5),
)
def test_the_lateness_is_known_however_the_object_creeps_and_whichever_presses_slip_ends(late, slips, **how):
    made = series_of(late, slips=slips, **how)
    known = late_s(made)
    assert known == pytest.approx(late + 0.5 * FRAME_S, abs=1e-6) or (known is None and len(made) == MOST_N)
    assert known is not None or len(slips) > 2


def test_two_slow_presses_come_before_each_fast_one_and_those_that_slip_ends_are_made_again():
    assert tuple(press.fast for press in series_of(0.05)) == ORDER
    slow_again = series_of(0.05, slips={2})
    assert late_s(series_of(0.05, slips={3, 6})) == pytest.approx(0.05 + 0.5 * FRAME_S), "the fourth fast press counts"
    assert [press.fast for press in slow_again][:5] == [False, False, False, False, True]
    fast_again = series_of(0.05, slips={3})
    assert tuple(press.fast for press in fast_again) == (*ORDER[:4], *ORDER[1:4], *ORDER[1:4])
    assert late_s(series_of(0.05, slips=set(range(MOST_N)))) is None
    assert len(series_of(0.05, slips=set(range(MOST_N)))) == MOST_N


def test_the_larger_of_both_values_counts_and_what_two_frames_leave_open_is_added():
    made = series_of(0.05)
    longer = [*made[:-1], pressed(True, 6.12, 0.05)]
    assert late_s(longer) == pytest.approx(0.07 + 0.5 * FRAME_S)
    assert late_s(made[:4]) is late_s([]) is None, "one fast press may be short by a frame"
    assert late_s(series_of(-0.05)) == pytest.approx(0.5 * FRAME_S), "nothing is seen before it happens"
    afresh = [press.model_copy(update={"afresh": number == 4}) for number, press in enumerate(series_of(0.05))]
    assert late_s(afresh) is None, "its first press in the new grasp is not counted"
    assert next_is_fast(afresh[:-1]) is False
    slides = series_of(0.05, crept_mm=0.8)
    assert late_s(slides) == pytest.approx(0.05 + FRAME_S), "its first motion is no straight line"
    assert late_s(series_of(0.05, frame_s=0.005)) == pytest.approx(0.08), "a press is not read more closely"


ENOUGH = wire.Enough(insertion_id=ID, attempt=1, frame_seq=3, captured_ns=30_000_000, pressed_mm=0.8)
SLIPPED = slip(1).model_copy(update={"captured_ns": 30_000_000, "pressed_mm": 0.8})


def watched(*events):
    """The state in which a press ends that goes down and meets these events, and what was kept of its stop."""
    watch, state = StopWatch(), State(PLAN.model_copy(update={"purpose": "timing"}))
    for event in (*TO_DESCENT, *events):
        state, _ = run([event], state)
        watch.on_event(state, event)
    return state, watch.stop


@pytest.mark.parametrize("order", [ENOUGH, SLIPPED])
def test_a_press_is_kept_with_its_speed_its_age_and_where_the_arm_stood(order):
    still = APPROACH.at_height(APPROACH.z_mm - 7.5)
    pairs = [service(watching(1, captured_s), 0.04) for captured_s in (0.0, 0.01, 0.03)]
    _, stop = watched(*pairs, service(order, 0.05), at(still, Standstill))
    assert stop.speed_mm_s == 10.0
    assert stop.waited_s == pytest.approx(0.02, abs=1e-3)
    assert (stop.pressed_mm, stop.depth_mm) == (0.8, 7.5)
    assert stop.frame_s == pytest.approx(0.015)
    assert stop.past_contact_mm(0.05) == pytest.approx(0.8 + 10.0 * 0.07, abs=0.01)


@pytest.mark.parametrize(("judged_s", "kept"), [((0.1, 0.2), True), ((0.1,), False)])
def test_a_press_in_which_the_arm_stood_for_want_of_a_frame_tells_nothing(judged_s, kept):
    """Its target stood, so its travel is not its speed times the time: it would seem hardly late at all."""
    pairs = [service(watching(1, at_s), at_s) for at_s in judged_s]
    lasts_s = PLAN.lasts_s
    order = service(ENOUGH.model_copy(update={"captured_ns": 150_000_000}), 0.1 + lasts_s + 0.01)
    state, stop = watched(*pairs, order, at(APPROACH.at_height(28.0), Standstill))
    assert (state.phase, stop is not None) == (Phase.DECIDING, kept)


def test_a_press_in_which_the_arm_stood_for_want_of_guidance_tells_nothing():
    stood = Stood(at_s=0.03, stood_s=0.1)
    state, stop = watched(stood, service(ENOUGH, 0.05), at(APPROACH.at_height(28.0), Standstill))
    assert (state.phase, stop) == (Phase.DECIDING, None)


def test_a_slip_without_a_known_contact_is_no_press():
    _, stop = watched(service(slip(1, pressed_mm=None), 0.05), at(APPROACH.at_height(28.0), Standstill))
    assert stop is None


@pytest.mark.parametrize(("rate_hz", "slow", "fast"), [(60.0, 4.0, 10.0), (15.0, 3.630, 9.076), (10.0, 3.0, 6.884)])
def test_the_fast_press_is_as_fast_as_cameras_and_limits_allow(rate_hz, slow, fast):
    legs = PLAN.model_copy(update={"pace": PLAN.pace.model_copy(update={"fast_mm_s": 20.0})})
    plans = slow_and_fast(legs, rate_hz)
    assert [plan.ramps.descend.speed_mm_s for plan in plans] == pytest.approx([slow, fast], abs=1e-3)
    assert {plan.pace.fast_mm_s for plan in plans} == {None}
    assert {plan.purpose for plan in plans} == {"timing"}, "nothing is learnt from them"
    narrow = PLAN.model_copy(update={"limits": PLAN.limits.model_copy(update={"max_descent_speed_mm_s": 4.0})})
    with pytest.raises(LimitError, match="do not tell how late"):
        slow_and_fast(narrow, rate_hz)


class Pressed(Cell):
    """A cell in which each press stops as it would with a lateness of 0.08 s; in a ``blind`` one none does."""

    def __init__(self, blind=False, **how):
        super().__init__(**how)
        self.presses, self.blind = [], blind

    async def press_at(self, x_mm, theta_deg, fast):
        self.presses.append((x_mm, theta_deg, fast, self.fetched_n))
        ended = await self.probe(x_mm, theta_deg)
        return ended._replace(stop=None if self.blind else pressed(fast, 6.0, 0.08).stop)


def timed(cell, path, record=None):
    running = commissioning(cell, path, record)
    running.press_at = cell.press_at
    return asyncio.run(running.run(6))


def test_the_presses_follow_the_signs_once_and_in_one_grasp(tmp_path):
    cell, path = Pressed(), tmp_path / "record.toml"
    record = timed(cell, path)
    again = timed(cell, path, read_record(path))
    assert record.late_s == again.late_s == pytest.approx(0.08 + 0.5 * FRAME_S)
    assert cell.presses == [(*PLACE, fast, len(SIDES) + 1) for fast in ORDER]
    assert record.model_copy(update={"timed": ()}).digest() != record.digest()


def test_a_series_that_tells_nothing_is_not_kept_and_made_again(tmp_path):
    cell, path = Pressed(blind=True), tmp_path / "record.toml"
    record = timed(cell, path)
    assert (record.timed, record.late_s, len(record.probes)) == ((), None, 2)
    assert len(cell.presses) == MOST_N
    cell.blind, cell.presses = False, []
    assert timed(cell, path, read_record(path)).late_s == pytest.approx(0.08 + 0.5 * FRAME_S)


def test_an_object_that_turns_in_the_hand_meanwhile_is_regrasped_and_the_series_goes_on(tmp_path):
    class Turning(Pressed):
        async def press_at(self, *how):
            ended = await super().press_at(*how)
            if len(self.presses) not in (6, 9):
                return ended
            return Ended((), Phase.FAILED, f"{REFUSED} it hangs turned by 0.6 deg", ended.gels)

    cell = Turning()
    record = timed(cell, tmp_path / "record.toml")
    assert record.late_s == pytest.approx(0.08 + 0.5 * FRAME_S)
    grasp = len(SIDES) + 1
    assert [fetched_n - grasp for *_, fetched_n in cell.presses] == [0] * 6 + [1] * 3 + [2] * 4
    assert [press.fast for press in record.timed] == [
        False,
        False,
        False,
        True,
        False,
        *[False] * 2,
        *[False] * 3,
        True,
    ]
    assert [number for number, press in enumerate(record.timed) if press.afresh] == [0, 5, 7]


def test_an_object_that_hangs_turned_in_each_grasp_ends_the_commissioning(tmp_path):
    class Hanging(Pressed):
        async def press_at(self, *how):
            ended = await super().press_at(*how)
            if len(self.presses) < 3:
                return ended
            return Ended((), Phase.FAILED, f"{REFUSED} it hangs turned by 0.6 deg", ended.gels)

    cell = Hanging()
    with pytest.raises(DriverError, match=r"slow press 3: service: refused: turned_in_hand: it hangs turned"):
        timed(cell, tmp_path / "record.toml")
    assert len(cell.presses) == 3 + GRASPS_N


def test_a_cell_that_cannot_be_timed_is_probed_all_the_same(tmp_path):
    class TooSlow(Pressed):
        async def press_at(self, *_):
            raise LimitError("presses at 3 and at 4.0 mm/s do not tell how late pictures and arm are")

    record = timed(TooSlow(), tmp_path / "record.toml")
    assert (record.late_s, record.labelled_n) == (None, 6)
