"""The commands of an insertion, each with the state that follows it. Pure, like the machine that uses them."""

import math
from dataclasses import replace

from robot_client.insertion.events import Command, Hold, Move, Send, Source
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.limits import Motion, check_pose
from robot_client.insertion.state import Phase, State
from service.contract import wire

Result = tuple[State, tuple[Command, ...]]


def send(message: wire.ClientMessage) -> Send:
    return Send(message=message)


def fail(state: State, source: Source, code: str, detail: str) -> Result:
    reason = f"{source}: {code}: {detail}"[:500]
    stop = source in ("arm", "operator") or state.phase is Phase.STOPPING
    abort = wire.Abort(insertion_id=state.plan.insertion_id, reason=reason)
    held = Hold(reason=reason, stop=stop)
    return replace(state, phase=Phase.FAILED, deadline_s=math.inf, path=(), reason=reason), (held, send(abort))


def go(state: State, phase: Phase, path: tuple[WorkPose, ...], motion: Motion, at_s: float) -> Result:
    """Send the arm along ``path``, one straight line at a time, if every corner of it is allowed."""
    plan = state.plan
    assert state.pose is not None
    try:
        for corner in path:
            check_pose(plan.limits, corner)
        duration_s = plan.ramps.duration_s(state.pose, path[0], motion)
    except ValueError as error:
        return fail(state, "limits", "target", str(error))
    deadline_s = at_s + 3.0 * duration_s + plan.timeouts.motion_s
    state = replace(state, phase=phase, path=path[1:], deadline_s=deadline_s)
    return state, (Move(target=path[0], motion=motion),)


def approach(state: State, at_s: float) -> Result:
    """Up along the vertical if the arm is below the approach height, over, then down: never sideways down low."""
    assert state.pose is not None
    end, here = state.plan.approach, state.pose
    height_mm = max(here.z_mm, end.z_mm)
    path = (here.at_height(height_mm), end.at_height(height_mm), end)
    return go(state, Phase.APPROACHING, path, "travel", at_s)


def arm(state: State, target: WorkPose, at_s: float) -> Result:
    """Stand above the gap at ``target`` (commanded, not measured: no drift adds up) and ask for a reference."""
    plan, attempt = state.plan, state.attempt + 1
    message = wire.Arm(
        insertion_id=plan.insertion_id,
        attempt=attempt,
        gap_width_mm=plan.gap_width_mm,
        grasp_height_mm=plan.grasp_height_mm,
        expected_depth_mm=plan.expected_depth_mm,
    )
    deadline_s = at_s + plan.timeouts.arming_s
    state = replace(state, phase=Phase.ARMING, attempt=attempt, armed=target, deadline_s=deadline_s)
    return state, (send(message),)


def descend(state: State, at_s: float) -> Result:
    assert state.armed is not None
    plan = state.plan
    bottom = state.armed.at_height(state.armed.z_mm - state.bottom_mm)
    state, commands = go(state, Phase.DESCENDING, (bottom,), "descend", at_s)
    if state.done:
        return state, commands
    message = wire.Descending(insertion_id=plan.insertion_id, attempt=state.attempt)
    return state, (send(message), *commands)


def hold(state: State, reason: str, at_s: float) -> Result:
    deadline_s = at_s + state.plan.timeouts.stopping_s
    return replace(state, phase=Phase.STOPPING, path=(), deadline_s=deadline_s), (Hold(reason=reason),)


def retract(state: State, dx_mm: float, dtheta_deg: float, at_s: float) -> Result:
    """Up along the recorded vertical, then by the correction in the air."""
    assert state.armed is not None
    path = (state.armed, state.armed.corrected(dx_mm, dtheta_deg))
    return go(state, Phase.RETRACTING, path, "retract", at_s)
