"""The effect of the gripper's events on an insertion. Pure, like the machine that uses them."""

from dataclasses import replace

from robot_client.insertion.actions import Result, approach, fail, hold, send
from robot_client.insertion.events import Grasp, Grasped, PartLost, Width
from robot_client.insertion.state import Phase, State
from service.contract import wire

LEAST_WAY_MM = 0.3  # fingers that close by less were closed before
INACCURACY_MM, WIDEST_MM = 1.0, 1000.0  # no message can state a larger width


def grasp(state: State, at_s: float) -> Result:
    deadline_s = at_s + state.plan.timeouts.grasping_s
    return replace(state, phase=Phase.GRASPING, open_mm=state.width_mm, deadline_s=deadline_s), (Grasp(),)


def on_gripper(state: State, event: Grasped | Width | PartLost) -> Result:
    """The state after an event of the gripper, and the commands to carry out."""
    if isinstance(event, Grasped | Width) and not -INACCURACY_MM <= event.width_mm <= WIDEST_MM:
        detail = f"tells a width of {event.width_mm:g} mm, expected {-INACCURACY_MM:g} .. {WIDEST_MM:g}: is it in mm?"
        return fail(state, "gripper", "width", detail)
    match event:
        case PartLost():
            return _on_part_lost(state, event)
        case Grasped() if state.phase is Phase.GRASPING:
            return _on_grasped(replace(state, width_mm=_width_mm(event)), event)
        case Width():
            return replace(state, width_mm=_width_mm(event)), ()
        case _:
            return state, ()


def _width_mm(event: Grasped | Width) -> float:
    """Closed fingers may seem to be closer than that by the gripper's inaccuracy; no message can say so."""
    return max(0.0, event.width_mm)


def _on_grasped(state: State, event: Grasped) -> Result:
    """Go on. Where the fingers were on the object all the time, what was learnt as open gels was none.

    So it is with a gripper that reports no part after its last client has left, although its fingers are still closed.
    """
    state, commands = approach(state, event.at_s)
    if state.held or state.open_mm is None or state.open_mm - event.width_mm >= LEAST_WAY_MM:
        return state, commands
    return state, (send(wire.LearnOpen(insertion_id=state.plan.insertion_id, forget=True)), *commands)


def forgotten(state: State, code: wire.FaultCode) -> str:
    """What to do about open gels that could not be learnt if the gripper has forgotten its part; else "".

    Gels that hold a part look like other gels than the calibrated ones; only the operator sees which of both it is.
    """
    if state.phase is not Phase.LEARNING or code != "open_gel":
        return ""
    apart = "its fingers" if state.width_mm is None else f"its fingers, {state.width_mm:.1f} mm apart,"
    return (
        f"; the gripper reports no part, as it also does after its client has left: if {apart} are on one,"
        " put it back where it is gripped and open them (`home --live --config FILE --direction outward`)"
    )


def _on_part_lost(state: State, event: PartLost) -> Result:
    if state.phase is Phase.CLOSING:  # it lies in its gap: releasing it is no loss
        return state, ()
    if state.phase is Phase.DESCENDING:
        return hold(replace(state, dropped=True), "part lost", event.at_s)
    if state.phase is Phase.STOPPING:
        return replace(state, dropped=True), ()
    return fail(state, "gripper", "part_lost", f"the object was lost while {state.phase}")
