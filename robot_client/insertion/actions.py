"""The commands of an insertion, each with the resulting state. Pure, like the machine that uses them."""

import itertools
import math
from dataclasses import replace

from robot_client.insertion.events import Command, Hold, Move, Renew, Send, Source
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.limits import Leg, LimitError, Motion, check_pose, check_straightening
from robot_client.insertion.motion import LOST_S
from robot_client.insertion.state import Phase, State
from service.contract import wire

_AHEAD_S = 0.001
_IN_PLACE_MM = 0.5  # an arm this close to the gap's vertical goes nowhere sideways
MOST_STOOD_S = 1.0  # no message can state more
Result = tuple[State, tuple[Command, ...]]


def send(message: wire.ClientMessage) -> Send:
    return Send(message=message)


_CAUSES: dict[str, wire.Cause] = {
    "unwatched": "unwatched",
    "attempts": "attempts",
    "part_lost": "part_lost",
    "no_decision": "no_decision",
    "contradictory": "no_decision",
    "non_finite": "no_decision",
    "refused": "refused",
    "timeout": "timeout",
    "not_seated": "not_confirmed",
    "not_seen": "not_confirmed",
    "not_confirmed": "not_confirmed",
    "afresh": "not_confirmed",  # and a regrasp is no longer possible
}
_SERVICE_CAUSES: dict[str, wire.Cause] = {
    "link": "link",
    "silent": "link",
    "camera": "camera",
    "camera_lost": "camera",
    "camera_stalled": "camera",
    "camera_frozen": "camera",
    "camera_size": "camera",
    "stale_frames": "camera",
}


def cause_of(source: Source, code: str) -> wire.Cause:
    """The cause that counts for a failure: by its code if that determines it, else by its source."""
    if cause := _CAUSES.get(code) or (_SERVICE_CAUSES.get(code) if source == "service" else None):
        return cause
    return source


def fail(state: State, source: Source, code: str, detail: str) -> Result:
    reason = f"{source}: {code}: {detail}"[:500]
    stop = source in ("arm", "operator") or state.phase is Phase.STOPPING
    failed = replace(state, phase=Phase.FAILED, deadline_s=math.inf, path=(), reason=reason)
    goes_on = state.plan.fixture and failed.afresh(state.plan.insertion_id) is not None
    cause: wire.Cause = "afresh" if goes_on else cause_of(source, code)
    abort = wire.Abort(insertion_id=state.plan.insertion_id, cause=cause, reason=reason)
    return failed, (Hold(reason=reason, stop=stop), send(abort))


def go(
    state: State,
    phase: Phase,
    path: tuple[WorkPose, ...],
    motion: Motion,
    at_s: float,
    until_s: float | None = None,
    legs: tuple[Leg, ...] = (),
) -> Result:
    """Send the arm along ``path``, one straight line at a time, if every corner of it is allowed."""
    plan = state.plan
    assert state.pose is not None
    try:
        for before, corner in itertools.pairwise((state.pose, *path)):
            check_pose(plan.limits, corner, here=before)
        duration_s = plan.ramps.duration_s(state.pose, path[0], motion)
    except ValueError as error:
        return fail(state, "limits", "target", str(error))
    deadline_s = at_s + 3.0 * duration_s + plan.timeouts.motion_s
    state = replace(state, phase=phase, path=path[1:], deadline_s=deadline_s)
    return state, (Move(target=path[0], motion=motion, until_s=until_s, legs=legs),)


def approach(state: State, at_s: float) -> Result:
    """Up along the vertical if the arm is lower than that, over, then down: never sideways low down.

    From below the approach it goes up slowly: the object may stand between the blocks, after a fault. One that was in
    the hand at the start stands in no fixture only where the arm is above the gap already.
    """
    assert state.pose is not None
    end, here, over_mm = state.plan.approach, state.pose, state.plan.over_mm
    aside_mm = here.at_height(end.z_mm).distance_mm(end)
    in_place = state.held and aside_mm <= _IN_PLACE_MM
    lifted_mm = end.z_mm if over_mm is None or in_place else over_mm
    height_mm = max(here.z_mm, end.z_mm, lifted_mm)
    path = (here.at_height(height_mm), end.at_height(height_mm), end)
    return go(state, Phase.APPROACHING, path, "retract" if here.z_mm < end.z_mm else "travel", at_s)


def arm(state: State, target: WorkPose, at_s: float) -> Result:
    """Stand above the gap at ``target`` (commanded, not measured: no drift accumulates) and request a reference."""
    plan, attempt = state.plan, state.attempt + (not state.arms_again)
    message = wire.Arm(
        insertion_id=plan.insertion_id,
        attempt=attempt,
        gap_width_mm=plan.gap_width_mm,
        grasp_height_mm=plan.grasp_height_mm,
        expected_depth_mm=plan.expected_depth_mm,
        gripper_width_mm=state.width_mm,
        grip_n=plan.grip_n,
        shear_reach_mm=plan.shear_reach_mm,
        press_mm=plan.pace.press_mm,
        until_slip=plan.until_slip and plan.only_probes,
        tilt_deg=target.tilt_deg,
        tops_level_mm=plan.tops_level_mm if plan.signs_known else None,
        neighbours_stay=plan.neighbours_stay,
    )
    deadline_s = at_s + plan.timeouts.arming_s
    state = replace(state, phase=Phase.ARMING, attempt=attempt, arms_again=False, armed=target, deadline_s=deadline_s)
    return state, (send(message),)


def straighten(state: State, tilt_deg: float, at_s: float) -> Result:
    """Tilt the tool in the air, once in an attempt, to hold a turned object upright; then arm again."""
    assert state.armed is not None
    try:
        check_straightening(state.plan.most_tilt_deg, tilt_deg)
    except LimitError as error:
        return fail(state, "limits", "straighten", str(error))
    if state.straightened == state.attempt:
        return fail(state, "service", "protocol", f"asked to tilt the tool again in attempt {state.attempt}")
    tilted = state.armed.tilted(tilt_deg)
    state = replace(state, armed=tilted, straightened=state.attempt, arms_again=True)
    return go(state, Phase.CORRECTING, (tilted,), "travel", at_s)


def descend(state: State, captured_ns: int, at_s: float) -> Result:
    """Descend on the lease of the reference frame; if that has become too old, on one judged after it."""
    state = watched(state, captured_ns, at_s)
    if at_s >= state.until_s:
        return state, ()
    assert state.armed is not None
    assert state.pose is not None
    plan, start_mm = state.plan, state.pose.z_mm
    bottom = state.armed.at_height(state.armed.z_mm - state.bottom_mm)
    probing_mm_s, state = plan.ramps.descend.speed_mm_s, replace(state, touched=False)
    legs = plan.pace.legs(start_mm, bottom.z_mm, probing_mm_s, state.tops)
    state, commands = go(state, Phase.DESCENDING, (bottom,), "descend", at_s, state.until_s, legs)
    if state.done:
        return state, commands
    speeds = plan.ramps.in_legs(start_mm, legs).speeds() if legs else [(0.0, 0.0, probing_mm_s)]
    state, messages = tell_speed(
        replace(state, speeds=tuple((at_s + after_s, way_mm, mm_s) for after_s, way_mm, mm_s in speeds))
    )
    return state, (*messages, *commands)


def tell_speed(state: State) -> Result:
    """Report the due speed and its starting point: networks that read depth need it."""
    assert state.armed is not None
    assert state.pose is not None
    (_, way_mm, speed_mm_s), *later = state.speeds
    start_mm = max(0.0, round(state.armed.z_mm - state.pose.z_mm + way_mm, 2))
    message = wire.Descending(
        insertion_id=state.plan.insertion_id, attempt=state.attempt, speed_mm_s=speed_mm_s, start_mm=start_mm
    )
    return replace(state, speed_mm_s=speed_mm_s, speeds=tuple(later)), (send(message),)


def watched(state: State, captured_ns: int, at_s: float) -> State:
    """The state with a judged frame of the service's stamp ``captured_ns``; an older or repeated one changes nothing.

    A stamp that is certainly in the future comes from a clock that jumped, and is ignored.
    """
    captured_s = -math.inf if state.clock is None else state.clock.ours_s(captured_ns, at_s)
    return replace(state, watched_s=captured_s) if state.watched_s < captured_s <= at_s + _AHEAD_S else state


def renew(state: State, captured_ns: int, at_s: float) -> Result:
    """Continue on a judged frame; a lease that ended too long ago is not renewed, however recent the frame is."""
    if at_s >= state.until_s + state.plan.pause_s:
        return unwatched(state, at_s)
    newer, stood_s = watched(state, captured_ns, at_s), max(0.0, at_s - state.until_s)
    if newer is state or at_s >= newer.until_s:  # judged too late to go on: the same pause continues
        return state, ()
    if not stood_s:
        return newer, (Renew(until_s=newer.until_s),)
    newer, paused = later(newer, stood_s)
    return newer, (Renew(until_s=newer.until_s), *paused)


def later(state: State, stood_s: float) -> Result:
    """The arm stood on its way: the rest of it comes that much later, which networks that read depth must know."""
    if stood_s > MOST_STOOD_S:
        return fail(state, "arm", "link", f"the descent stood for {stood_s:.2f} s, allowed up to {MOST_STOOD_S:g} s")
    speeds = tuple((due_s + stood_s, way_mm, mm_s) for due_s, way_mm, mm_s in state.speeds)
    paused = wire.Descending(
        insertion_id=state.plan.insertion_id, attempt=state.attempt, speed_mm_s=state.speed_mm_s, paused_s=stood_s
    )
    return replace(state, speeds=speeds), (send(paused),)


def unwatched(state: State, at_s: float) -> Result:
    """Hold for good: no judged frames arrive."""
    age_ms, allowed_ms = (at_s - state.watched_s) * 1e3, (state.until_s - state.watched_s) * 1e3
    known = "the service's clock is not known" if state.clock is None else f"judged {age_ms:.0f} ms ago"
    if state.clock is not None:
        known += f", of which {state.clock.uncertainty_s * 1e3:.1f} ms are the clocks'"
    return fail(state, "service", "unwatched", f"newest frame {known}; allowed {allowed_ms:.0f} ms")


def finished(state: State, message: wire.Finished) -> Result:
    """The insertion is over: claimed at full depth, else failed. One that was over before it began moves nothing."""
    if state.phase is Phase.CLOSING and message.outcome == "inserted":
        return replace(state, phase=Phase.INSERTED, deadline_s=math.inf), ()
    if state.phase is Phase.GREETING:
        known = f"insertion {state.plan.insertion_id} ended before ({message.outcome}) and was not begun again"
        return fail(state, "service", "finished", f"{known}: give this one another --insertion-id")
    if message.doubts:
        doubts = "; ".join(doubt.detail for doubt in message.doubts)
        return fail(state, "service", message.cause or message.outcome, f"full depth was reached, but {doubts}")
    return fail(state, "service", "finished", f"the service closed the insertion: {message.outcome}")


def hold(state: State, reason: str, at_s: float) -> Result:
    deadline_s = at_s + state.plan.timeouts.stopping_s
    return replace(state, phase=Phase.STOPPING, path=(), deadline_s=deadline_s), (Hold(reason=reason),)


def stop(state: State, message: wire.Slip | wire.Enough, at_s: float) -> Result:
    """Stop at once. Where the frame shows an arm that stood by then, the service learns it before it decides."""
    felt = f"slip on finger {message.finger}" if message.type == "slip" else f"pressed by {message.pressed_mm:.2f} mm"
    stopping = replace(state, touched=message.pressed_mm is not None)
    stopping, commands = hold(stopping, f"{felt}, frame {message.frame_seq}", at_s)
    captured_s = -math.inf if state.clock is None else state.clock.ours_s(message.captured_ns, at_s)
    if captured_s - state.until_s < LOST_S:
        return stopping, commands
    return stopping, (*commands, *later(state, at_s - state.until_s)[1])


def lift(state: State, at_s: float, *, ends: bool = False) -> Result:
    """Up from a probe's attempt, and over to its next start, in the air; without another one, or ``ends``: only up."""
    assert state.armed is not None
    up = state.armed
    starts = () if ends else state.plan.starts[state.attempt - 1 : state.attempt]
    over = (start.at_height(up.z_mm).tilted(up.tilt_deg) for start in starts)
    return go(state, Phase.RETRACTING, (up, *over), "retract", at_s)


def probed(state: State) -> Result:
    """The probe is done and the arm stands above the gap."""
    abort = wire.Abort(insertion_id=state.plan.insertion_id, cause="probed", reason="a probe, done")
    return replace(state, phase=Phase.PROBED, deadline_s=math.inf), (send(abort),)


def retract(state: State, dx_mm: float, dtheta_deg: float, at_s: float) -> Result:
    """Up along the recorded vertical, then by the correction in the air."""
    assert state.armed is not None
    assert state.pose is not None
    plan, stop_mm = state.plan, state.pose.z_mm
    tops = state.tops.with_stop(stop_mm)
    up = state.armed.at_height(plan.pace.up_to_mm(state.armed.z_mm, plan.tops, tops, stop_mm))
    path, state = (up, up.corrected(dx_mm, dtheta_deg)), replace(state, met=tops)
    return go(state, Phase.RETRACTING, path, "retract", at_s)
