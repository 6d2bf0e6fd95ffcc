"""Why an insertion ends, who is to blame, and what comes after: as the service and the next insertion hear it."""

from dataclasses import replace

import pytest

from robot_client.insertion.actions import cause_of
from robot_client.insertion.events import Begin, Failure, Hold, Move, PartLost, Send, Standstill, Tick
from robot_client.insertion.lease import PAUSE_S, Lease
from robot_client.insertion.limits import LimitError, Limits
from robot_client.insertion.machine import Phase, State, step
from robot_client.insertion.pace import Pace
from robot_client.insertion.seconds import DECIDE, FAST, Seconds
from service.contract import wire
from tests.robot_client.insertion.stories import (
    APPROACH,
    ID,
    PLAN,
    TO_ARMING,
    TO_CLOSING,
    TO_DECISION,
    TO_DESCENT,
    TO_STOP,
    armed,
    at,
    correction,
    hello,
    no_decision,
    run,
    service,
    slip,
    watching,
)

TO_RETRACTING = [*TO_DECISION, service(correction(1))]
STORIES = {
    Phase.GREETING: (TO_ARMING[:1], "service"),
    Phase.LEARNING: ([TO_ARMING[0].model_copy(update={"held": False}), service(hello())], "service"),
    Phase.GRASPING: (TO_ARMING[:2], "gripper"),
    Phase.APPROACHING: (TO_ARMING[:3], "arm"),
    Phase.ARMING: (TO_ARMING, "service"),
    Phase.STOPPING: (TO_STOP, "arm"),
    Phase.DECIDING: (TO_DECISION, "service"),
    Phase.RETRACTING: (TO_RETRACTING, "arm"),
    Phase.CORRECTING: ([*TO_RETRACTING, at(APPROACH)], "arm"),
    Phase.CLOSING: (TO_CLOSING, "service"),
}


@pytest.mark.parametrize("phase", STORIES, ids=[phase.value for phase in STORIES])
def test_whom_a_phase_waits_for_is_to_blame_when_it_takes_too_long(phase):
    story, source = STORIES[phase]
    state, _ = run(story)
    assert state.phase is phase
    assert step(state, Tick(at_s=state.deadline_s - 0.001)) == (state, ())
    state, commands = step(state, Tick(at_s=state.deadline_s))
    assert state.reason.startswith(f"{source}: timeout: {phase} took longer than allowed (attempt {state.attempt})")
    assert state.reason.endswith("not claimed") == (phase is Phase.CLOSING)
    hold, abort = commands
    assert hold.stop == (source == "arm"), "a controller that does not follow is stopped by its program"
    assert abort.message.cause == "timeout"


@pytest.mark.parametrize("phase", [Phase.APPROACHING, Phase.STOPPING, Phase.DECIDING])
@pytest.mark.parametrize("source", ["arm", "operator", "service", "gripper", "client"])
def test_the_program_is_stopped_where_the_arm_or_the_operator_says_so_or_the_arm_is_being_held(phase, source):
    state, _ = run(STORIES[phase][0])
    _, commands = step(state, Failure(at_s=0.0, source=source, code="fault", detail="d"))
    assert isinstance(commands[0], Hold)
    assert commands[0].stop == (source in {"arm", "operator"} or phase is Phase.STOPPING)
    assert commands[1].message.reason == commands[0].reason == f"{source}: fault: d"


@pytest.mark.parametrize(
    ("source", "code", "cause"),
    [
        ("service", "unwatched", "unwatched"),
        ("arm", "unwatched", "unwatched"),
        ("client", "attempts", "attempts"),
        ("service", "contradictory", "no_decision"),
        ("service", "non_finite", "no_decision"),
        ("service", "not_seen", "not_confirmed"),
        ("service", "afresh", "not_confirmed"),
        ("service", "link", "link"),
        ("service", "silent", "link"),
        ("service", "camera_lost", "camera"),
        ("service", "stale_frames", "camera"),
        ("arm", "link", "arm"),
        ("arm", "silent", "arm"),
        ("gripper", "link", "gripper"),
        ("gripper", "part_lost", "part_lost"),
        ("service", "internal", "service"),
        ("limits", "target", "limits"),
    ],
)
def test_a_cause_is_told_by_its_code_where_that_says_enough_and_else_by_whose_it_is(source, code, cause):
    assert cause_of(source, code) == cause


def test_however_long_a_reason_is_the_service_is_told():
    state, _ = run(TO_ARMING)
    _, commands = step(state, Failure(at_s=0.0, source="arm", code="fault", detail="x" * 5000))
    message = commands[1].message
    assert wire.parse_client(message.model_dump_json()) == message
    assert len(message.reason) > 400


def refused_at(attempt, reason="turned_in_hand", **changes):
    """An insertion whose so-many-th arming was refused, the attempts before it blocked."""
    state, _ = run(TO_ARMING, State(PLAN.model_copy(update=changes)))
    for number in range(1, attempt):
        here = state.armed
        blocked = [service(armed(number)), service(slip(number)), at(here.at_height(28.0), Standstill)]
        state, _ = run([*blocked, service(correction(number)), at(here), at(here.corrected(-3.0, -2.0))], state)
    return run(
        [service(wire.Refused(insertion_id=ID, attempt=attempt, reason=reason, detail="turned by 3 deg"))], state
    )


@pytest.mark.parametrize(
    ("attempt", "fixture", "reason", "left_n"),
    [
        (2, True, "turned_in_hand", 2),
        (3, True, "turned_in_hand", 1),
        (1, True, "turned_in_hand", None),
        (2, True, "nothing_held", None),
        (2, False, "turned_in_hand", 2),
    ],
)
def test_a_turned_object_is_taken_afresh_with_the_attempts_that_are_left_of_three(attempt, fixture, reason, left_n):
    """A refused attempt does not count: the arm has not descended. Before the first one nothing can have turned it."""
    state, commands = refused_at(attempt, reason, fixture=fixture, limits=Limits(max_attempts=3))
    again = state.afresh("next")
    assert (None if again is None else again.limits.max_attempts) == left_n
    assert state.tried_n == attempt - (reason == "turned_in_hand")
    goes_on = fixture and left_n is not None
    assert commands[-1].message.cause == ("afresh" if goes_on else "refused")
    if again is not None:
        last = APPROACH.corrected(-3.0 * (attempt - 1), -2.0 * (attempt - 1))
        assert (again.insertion_id, again.continues, again.approach) == ("next", ID, last)
        assert replace(state, no_decisions=2).afresh("next").no_decisions == 2


@pytest.mark.parametrize(("before_mm_s", "after_mm_s"), [(10.0, 5.0), (6.0, 4.0), (3.0, 3.0)])
def test_after_a_turn_the_arm_probes_at_half_the_speed_but_no_slower_than_pictures_need(before_mm_s, after_mm_s):
    ramp = PLAN.ramps.descend.model_copy(update={"speed_mm_s": before_mm_s})
    ramps = PLAN.ramps.model_copy(update={"descend": ramp})
    state, _ = refused_at(2, ramps=ramps, lease=Lease(travel_mm=1.0))
    again = state.afresh("next")
    assert again.ramps.descend.speed_mm_s == after_mm_s
    assert again.lease.travel_mm == 1.0


def test_a_frame_in_time_prolongs_the_lease_and_delays_no_speed():
    plan = PLAN.model_copy(update={"pace": Pace(fast_mm_s=12.0), "pause_s": PAUSE_S})
    state, _ = run([TO_ARMING[0], service(hello(cameras=())), *TO_ARMING[2:], service(armed(1))], State(plan))
    assert len(state.speeds) > 1
    later, _ = step(state, service(watching(1, 0.05), 0.06))
    assert later.speeds == state.speeds


@pytest.mark.parametrize(("ahead_s", "counts"), [(0.0009, True), (0.0011, False)])
def test_a_stamp_may_lie_a_millisecond_ahead_of_our_clock(ahead_s, counts):
    state, _ = run(TO_DESCENT)
    later, commands = step(state, service(watching(1, 0.05 + ahead_s), 0.05))
    assert (later is not state) == bool(commands) == counts


def test_who_was_not_watched_is_told_since_when_and_how_long_was_allowed():
    state, _ = run(TO_DESCENT)
    state, _ = step(state, service(watching(1, 0.05), 0.06))
    state, _ = step(state, Tick(at_s=0.3))
    assert state.reason == (
        "service: unwatched: newest frame judged 250 ms ago, of which 0.0 ms are the clocks'; allowed 110 ms"
    )


def probe(outcome_mm, **changes):
    plan = PLAN.model_copy(update={"purpose": "probe"} | changes)
    stopped = at(APPROACH.at_height(APPROACH.z_mm - outcome_mm), Standstill)
    return run([*TO_STOP, stopped], State(plan))


def test_a_probe_ends_above_the_gap_whatever_it_met_and_presses_until_slip_where_it_is_to():
    state, commands = probe(25.0)
    assert (state.phase, commands[-1].target, commands[-1].motion) == (Phase.RETRACTING, APPROACH, "retract")
    assert not [c for c in commands if isinstance(c, Send) and c.message.type == "stopped"], "there is nothing to tell"
    state, commands = probe(7.0)
    assert state.phase is Phase.DECIDING
    state, (up,) = step(state, service(correction(1, 9.0, 9.0)))
    assert (up.target, state.path) == (APPROACH, ())
    state, (abort,) = step(state, at(APPROACH))
    assert (state.phase, abort.message.cause) == (Phase.PROBED, "probed")
    for purpose, until_slip in (("probe", True), ("insert", True), ("probe", False)):
        plan = PLAN.model_copy(update={"purpose": purpose, "until_slip": until_slip})
        _, commands = run(TO_ARMING, State(plan))
        assert commands[-1].message.until_slip == (purpose == "probe" and until_slip)


def test_the_last_attempt_may_still_go_in():
    state, _ = run(TO_STOP, State(PLAN.model_copy(update={"limits": Limits(max_attempts=1)})))
    inserted, _ = step(state, at(APPROACH.at_height(10.5), Standstill))
    assert inserted.phase is Phase.CLOSING
    blocked, _ = step(state, at(APPROACH.at_height(12.0), Standstill))
    assert blocked.reason == "client: attempts: the last attempt, number 1, was blocked"
    limited = {"limits": Limits(max_attempts=1), "continues": "before"}
    again, _ = step(run(TO_STOP, State(PLAN.model_copy(update=limited)))[0], at(APPROACH.at_height(12.0), Standstill))
    assert again.reason == "client: attempts: the last attempt, number 1 since it was regrasped, was blocked"


@pytest.mark.parametrize("phase", [Phase.APPROACHING, Phase.ARMING, Phase.DECIDING, Phase.CLOSING])
def test_a_part_that_is_lost_while_nothing_descends_ends_the_insertion_unless_it_lies_in_its_gap(phase):
    state, _ = run(STORIES[phase][0])
    after, commands = step(state, PartLost(at_s=0.0))
    if phase is Phase.CLOSING:
        assert (after, commands) == (state, ())
    else:
        assert after.reason == f"gripper: part_lost: the object was lost while {phase}"


@pytest.mark.parametrize("story", [TO_ARMING, TO_DECISION, TO_RETRACTING, TO_CLOSING])
def test_messages_for_another_phase_move_nothing(story):
    state, _ = run(story)
    expected = {Phase.ARMING: {"armed", "watching"}, Phase.DECIDING: {"correction"}}.get(state.phase, set())
    for message in (armed(1), watching(1, 0.0), slip(1), correction(1), wire.OpenLearnt(insertion_id=ID), hello()):
        _, commands = step(state, service(message))
        assert bool([c for c in commands if isinstance(c, Move)]) == (message.type in expected), message.type
    enough = wire.Enough(insertion_id=ID, attempt=1, frame_seq=3, captured_ns=7, pressed_mm=1.2)
    assert step(state, service(enough)) == (state, ())


def test_an_insertion_closed_early_failed_by_what_the_service_says():
    for cause, code in (("camera", "camera"), (None, "not_confirmed")):
        doubt = wire.Doubt(reason="push", detail="still pushed")
        ended = wire.Finished(insertion_id=ID, outcome="not_confirmed", attempts=1, cause=cause, doubts=(doubt,))
        state, _ = run([*TO_CLOSING, service(ended)])
        assert state.reason == f"service: {code}: full depth was reached, but still pushed"
    state, _ = run([*TO_DECISION, service(wire.Finished(insertion_id=ID, outcome="inserted", attempts=1))])
    assert state.reason == "service: finished: the service closed the insertion: inserted"


@pytest.mark.parametrize("cause", [None, "afresh"])
def test_an_insertion_whose_id_was_used_before_says_so_and_moves_nothing(cause):
    doubts = (wire.Doubt(reason="push", detail="still pushed"),) if cause else ()
    outcome = "regrasped" if cause else "inserted"
    before = wire.Finished(insertion_id=ID, outcome=outcome, attempts=1, cause=cause, doubts=doubts)
    state, commands = run([TO_ARMING[0], service(before)])
    assert state.phase is Phase.FAILED
    assert f"insertion {ID} ended before ({outcome})" in state.reason
    assert state.reason.endswith("give this one another --insertion-id")
    assert not [command for command in commands if isinstance(command, Move)]


@pytest.mark.parametrize(
    ("fast_mm_s", "pause_s", "rate_hz", "fast"),
    [(15.0, PAUSE_S, 60.0, True), (15.0, 0.0, 60.0, False), (None, PAUSE_S, 60.0, False), (10.0, PAUSE_S, 60.0, False)],
)
def test_a_descent_has_fast_legs_where_arm_and_cameras_allow_it(fast_mm_s, pause_s, rate_hz, fast):
    camera = wire.CameraEntry(finger="left", source="s", state="live", frame_rate_hz=rate_hz)
    plan = PLAN.model_copy(update={"pace": Pace(fast_mm_s=fast_mm_s), "pause_s": pause_s})
    state, _ = run([TO_ARMING[0], service(hello(cameras=(camera,)))], State(plan))
    assert state.plan.pace.fast_mm_s == (15.0 if fast else None)


def test_no_pace_is_as_fast_as_one_beyond_its_limits():
    with pytest.raises(LimitError, match=r"pace.fast_mm_s = 15.1, allowed up to 15"):
        Pace(fast_mm_s=15.1).check(Limits())
    Pace(fast_mm_s=15.0).check(Limits())
    Pace(fast_mm_s=None).check(Limits())


def test_a_fast_leg_is_accounted_for_by_itself_and_a_decision_that_tells_no_time_takes_none():
    seconds, state = Seconds(), State(PLAN, phase=Phase.DESCENDING, speed_mm_s=25.0)
    assert (seconds.total_s, set(seconds.spent.values())) == (0.0, {0.0})
    seconds.on_event(state, Tick(at_s=10.0))
    seconds.on_event(replace(state, speed_mm_s=10.0), Tick(at_s=11.0))
    seconds.on_event(replace(state, phase=Phase.DECIDING), Tick(at_s=13.0))
    seconds.on_event(replace(state, phase=Phase.RETRACTING), service(correction(1), 13.5))
    spent = {name: s for name, s in seconds.spent.items() if s}
    assert spent == {FAST: 1.0, "guarded descent": 2.0, "wait for frames": 0.5}
    assert (seconds.spent[DECIDE], seconds.total_s) == (0.0, 3.5)


def test_the_service_is_told_when_it_was_greeted():
    _, (greeting,) = step(State(PLAN), Begin(at_s=12.5, pose=APPROACH))
    assert greeting.message.sent_ns == 12_500_000_000


@pytest.mark.parametrize(("before_n", "goes_on"), [(0, True), (1, True), (2, False)])
def test_attempts_without_a_decision_count_across_a_regrasp(before_n, goes_on):
    """Two in a row are allowed; a correction in between starts anew."""
    state, _ = run(TO_DECISION, State(PLAN.model_copy(update={"no_decisions": before_n})))
    undecided, _ = step(state, service(no_decision(1)))
    assert (undecided.phase is not Phase.FAILED) == goes_on
    corrected, _ = step(state, service(correction(1)))
    assert corrected.no_decisions == 0
