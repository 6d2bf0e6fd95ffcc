"""The insertion as a pure state machine: ``step(state, event) -> (state, commands)``. It owns no clock and no socket.

greeting -> learning -> grasping -> approaching -> arming -> descending -> stopping -> closing -> inserted
                                                    ^                        |
                                               correcting <- retracting <- deciding        any phase -> failed

Arming leads to correcting, and back, where the tool is tilted to straighten the object.

The same machine drives the live cell, the dry run, the lock-step simulation and the replay of an episode log.
A probe ends ``probed``, above the gap. Once it is over no event makes it order anything.
"""

from collections.abc import Callable
from dataclasses import replace

from robot_client.insertion.actions import (
    Result,
    arm,
    descend,
    fail,
    finished,
    go,
    hold,
    later,
    lift,
    probed,
    renew,
    retract,
    send,
    stop,
    straighten,
    tell_speed,
    unwatched,
)
from robot_client.insertion.events import (
    Arrived,
    Begin,
    Event,
    Failure,
    FromService,
    Grasped,
    PartLost,
    Source,
    Standstill,
    Stood,
    Tick,
    Width,
)
from robot_client.insertion.grip import forgotten, grasp, on_gripper
from robot_client.insertion.lease import ClockMap
from robot_client.insertion.limits import LimitError, check_correction, check_descended
from robot_client.insertion.state import Phase, Plan, State, Timeouts
from service.contract import wire

__all__ = ["Phase", "Plan", "Result", "State", "Timeouts", "step"]


def step(state: State, event: Event) -> Result:
    """The state after ``event`` and the commands to carry out, in order. Never raises on any event."""
    if state.done:
        return state, ()
    match event:
        case Failure():
            result = fail(state, event.source, event.code, event.detail + _unclaimed(state))
        case Tick():
            result = _on_tick(state, event)
        case FromService():
            result = _on_service(state, event)
        case Grasped() | Width() | PartLost():
            result = on_gripper(state, event)
        case Begin() if state.phase is Phase.START:
            result = _on_begin(state, event)
        case Arrived() if state.phase in _ON_ARRIVAL:
            result = _ON_ARRIVAL[state.phase](replace(state, pose=event.pose), event)
        case Standstill() if state.phase is Phase.STOPPING:
            result = _on_standstill(state, event)
        case Stood() if state.phase is Phase.DESCENDING:
            result = later(state, event.stood_s)
        case _:
            result = state, ()
    return result


def _on_tick(state: State, event: Tick) -> Result:
    if state.phase is Phase.DESCENDING and event.at_s >= state.until_s + state.plan.pause_s:
        return unwatched(state, event.at_s)
    if state.phase is Phase.DESCENDING and state.speeds and min(event.at_s, state.until_s) >= state.speeds[0][0]:
        return tell_speed(state)
    if event.at_s < state.deadline_s:
        return state, ()
    grasping, moving = state.phase is Phase.GRASPING, state.phase in _MOVING
    source: Source = "gripper" if grasping else "arm" if moving else "service"
    detail = f"{state.phase} took longer than allowed (attempt {state.attempt})"
    return fail(state, source, "timeout", detail + _unclaimed(state))


def _unclaimed(state: State) -> str:
    """The meaning of a failure after the last standstill: depth alone is no insertion, the gels decide."""
    if state.phase is not Phase.CLOSING:
        return ""
    return "; full depth was reached, but the service did not confirm that the object came along: not claimed"


_MOVING = frozenset({Phase.APPROACHING, Phase.DESCENDING, Phase.STOPPING, Phase.RETRACTING, Phase.CORRECTING})


def _on_begin(state: State, event: Begin) -> Result:
    plan = state.plan
    try:
        plan.check()
    except LimitError as error:
        return fail(state, "limits", "plan", str(error))
    hello = wire.ClientHello(
        insertion_id=plan.insertion_id,
        client=plan.client,
        sent_ns=round(event.at_s * 1e9),
        controller=plan.controller,
        continues=plan.continues,
        takes_afresh=plan.fixture,
        most_tilt_deg=plan.most_tilt_deg,
        purpose=plan.purpose,
    )
    state = replace(state, phase=Phase.GREETING, pose=event.pose, held=event.held, no_decisions=plan.no_decisions)
    return replace(state, deadline_s=event.at_s + plan.timeouts.greeting_s), (send(hello),)


def _on_approached(state: State, event: Arrived) -> Result:
    if state.path:
        return go(state, Phase.APPROACHING, state.path, "travel", event.at_s)
    return arm(state, state.plan.approach, event.at_s)


def _on_standstill(state: State, event: Standstill) -> Result:
    """Report the depth: short of full depth is blocked; at full depth the service decides on the insertion."""
    assert state.armed is not None
    try:
        check_descended(state.armed, state.bottom_mm, event.pose)
    except LimitError as error:
        return fail(state, "arm", "tracking", str(error))
    plan, depth_mm = state.plan, state.armed.z_mm - event.pose.z_mm
    state = replace(state, pose=event.pose, stopped_s=event.at_s)
    inserted = depth_mm >= plan.expected_depth_mm - plan.depth_tolerance_mm
    outcome: wire.Outcome = "dropped" if state.dropped else "inserted" if inserted else "blocked"
    if outcome == "blocked" and state.touched:
        first_mm = depth_mm if state.first_touch_mm is None else state.first_touch_mm
        state = replace(state, first_touch_mm=first_mm, creep_mm=max(0.0, depth_mm - first_mm))
    stopped = send(
        wire.Stopped(
            insertion_id=plan.insertion_id,
            attempt=state.attempt,
            depth_mm=depth_mm,
            outcome=outcome,
            gripper_width_mm=state.width_mm,
            still_s=min(event.still_s, 1.0),  # all it holds; less only lengthens the wait for the last frame
        )
    )
    if outcome == "dropped":
        state, commands = fail(state, "gripper", "part_lost", f"the object was lost at {depth_mm:.2f} mm")
        return state, (stopped, *commands)
    if outcome == "blocked" and state.attempt >= plan.limits.max_attempts and not plan.only_probes:
        number = f"number {state.attempt}{' since it was regrasped' if plan.continues else ''}"
        state, commands = fail(state, "client", "attempts", f"the last attempt, {number}, was blocked")
        return state, (stopped, *commands)
    if plan.only_probes and outcome == "inserted":  # no contact, so there is nothing to report
        return lift(state, event.at_s, ends=True)
    phase, wait_s = (Phase.CLOSING, plan.timeouts.closing_s) if inserted else (Phase.DECIDING, plan.timeouts.deciding_s)
    return replace(state, phase=phase, deadline_s=event.at_s + wait_s), (stopped,)


def _on_retracted(state: State, event: Arrived) -> Result:
    if state.plan.only_probes and not state.path:
        return probed(state)
    assert state.armed is not None
    state = replace(state, armed=state.path[0].at_height(state.armed.z_mm))  # the vertical of the next attempt
    return go(state, Phase.CORRECTING, state.path, "travel", event.at_s)


def _on_corrected(state: State, event: Arrived) -> Result:
    assert state.armed is not None
    return arm(state, state.armed, event.at_s)


_ON_ARRIVAL: dict[Phase, Callable[[State, Arrived], Result]] = {
    Phase.APPROACHING: _on_approached,
    Phase.DESCENDING: lambda state, event: hold(state, "depth reached", event.at_s),
    Phase.RETRACTING: _on_retracted,
    Phase.CORRECTING: _on_corrected,
}


# ---- the service ----------------------------------------------------------------------------------------------------


def _on_service(state: State, event: FromService) -> Result:
    message, at_s = event.message, event.at_s
    if isinstance(message, wire.Fault):  # of any insertion: a fault of the connection names none
        return fail(state, "service", message.code, message.detail + forgotten(state, message.code))
    if message.insertion_id != state.plan.insertion_id:
        detail = f"message of insertion {message.insertion_id}, expected {state.plan.insertion_id}"
        return fail(state, "service", "protocol", detail)
    result: Result = state, ()
    match message:
        case wire.ServiceHello():
            result = _on_hello(state, message, at_s)
        case wire.ServiceHeartbeat():
            result = _on_clock(state, message.clock, at_s)
        case wire.OpenLearnt() if state.phase is Phase.LEARNING:
            result = grasp(state, at_s)
        case wire.Finished():
            result = finished(state, message)
        case wire.Armed() | wire.Straighten() | wire.Refused() | wire.Watching() | wire.Slip() | wire.Enough():
            result = _on_attempt_message(state, message, at_s)
        case wire.Correction() | wire.NoDecision():
            result = _on_attempt_message(state, message, at_s)
    return result


def _on_hello(state: State, message: wire.ServiceHello, at_s: float) -> Result:
    if message.protocol != wire.PROTOCOL:
        return fail(state, "service", "protocol", f"protocol {message.protocol}, expected {wire.PROTOCOL}")
    lost = [camera.finger for camera in message.cameras if camera.state == "lost"]
    if lost:
        return fail(state, "service", "camera", f"camera of finger {', '.join(lost)} is lost")
    if state.phase is not Phase.GREETING:
        return state, ()
    try:
        state.plan.check_cameras(message.cameras)
    except LimitError as error:
        return fail(state, "limits", "camera", str(error))
    state, _ = _on_clock(replace(state, plan=state.plan.with_legs_for(message.cameras)), message.clock, at_s)
    if state.held:  # the gels are loaded: only a print that is regular by itself can show their touch
        return grasp(state, at_s)
    deadline_s = at_s + state.plan.timeouts.arming_s
    learn = send(wire.LearnOpen(insertion_id=state.plan.insertion_id))
    return replace(state, phase=Phase.LEARNING, deadline_s=deadline_s), (learn,)


def _on_clock(state: State, clock: wire.Clock | None, at_s: float) -> Result:
    """A reading of both clocks narrows their mapping; a heartbeat serves only this, it shows no frame."""
    if clock is None:
        return state, ()
    read = ClockMap.read(clock, at_s)
    mapped = read if state.clock is None else state.clock.narrowed(read)
    if mapped is None:
        detail = "the service's clock and ours contradict their earlier readings: one of them stood still or jumped"
        return fail(state, "service", "clock", detail)
    return replace(state, clock=mapped), ()


def _on_attempt_message(state: State, message: wire.AttemptMessage, at_s: float) -> Result:
    """Late messages of an older attempt and repeated ones change nothing; one of a future attempt is a fault."""
    if message.attempt > state.attempt:
        detail = f"{message.type} of attempt {message.attempt} during attempt {state.attempt}"
        return fail(state, "service", "protocol", detail)
    if isinstance(message, wire.Slip | wire.Enough) and state.phase is Phase.DESCENDING:  # of any attempt: it is safe
        return stop(state, message, at_s)
    if message.attempt < state.attempt:
        return state, ()
    result: Result = state, ()
    match message:
        case wire.Armed() | wire.Watching() if state.phase is Phase.ARMING:
            result = descend(state, message.frame_captured_ns, at_s)
        case wire.Straighten() if state.phase is Phase.ARMING:
            result = straighten(state, message.tilt_deg, at_s)
        case wire.Refused() if state.phase is Phase.ARMING:
            result = fail(state, "service", "refused", f"{message.reason}: {message.detail}")
        case wire.Watching() if state.phase is Phase.DESCENDING:
            result = renew(state, message.frame_captured_ns, at_s)
        case wire.Correction() if state.phase is Phase.DECIDING:
            result = _on_correction(state, message, at_s)
        case wire.NoDecision() if state.phase is Phase.DECIDING:
            result = _on_no_decision(state, message, at_s)
    return result


def _on_correction(state: State, message: wire.Correction, at_s: float) -> Result:
    """Applied once: the phase leaves DECIDING with it, so a repeated correction finds nothing to do."""
    if state.plan.only_probes:
        return lift(state, at_s)
    try:
        age_s = at_s - state.stopped_s
        check_correction(state.plan.limits, message.attempt, message.dx_mm, message.dtheta_deg, age_s)
    except LimitError as error:
        return fail(state, "limits", "correction", str(error))
    return retract(replace(state, no_decisions=0), message.dx_mm, message.dtheta_deg, at_s)


def _on_no_decision(state: State, message: wire.NoDecision, at_s: float) -> Result:
    """Probe the same spot again, the only motion without a guess; not for ever, and never where the cell is broken."""
    if state.plan.only_probes:
        return lift(state, at_s)
    if message.reason in ("contradictory", "non_finite"):
        return fail(state, "service", message.reason, message.detail)
    if state.no_decisions >= state.plan.max_no_decisions:
        return fail(state, "service", "no_decision", f"{message.reason}: {message.detail}")
    return retract(replace(state, no_decisions=state.no_decisions + 1), 0.0, 0.0, at_s)
