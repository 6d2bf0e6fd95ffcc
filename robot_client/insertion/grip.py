"""The effect of the gripper's events on an insertion. Pure, like the machine that uses them."""

from dataclasses import replace

from robot_client.insertion.actions import Result, approach, fail, hold
from robot_client.insertion.events import Grasp, Grasped, PartLost, Width
from robot_client.insertion.state import Phase, State


def grasp(state: State, at_s: float) -> Result:
    return replace(state, phase=Phase.GRASPING, deadline_s=at_s + state.plan.timeouts.grasping_s), (Grasp(),)


def on_gripper(state: State, event: Grasped | Width | PartLost) -> Result:
    """The state after an event of the gripper, and the commands to carry out."""
    match event:
        case PartLost():
            return _on_part_lost(state, event)
        case Grasped() if state.phase is Phase.GRASPING:
            return approach(replace(state, width_mm=event.width_mm), event.at_s)
        case Width():
            return replace(state, width_mm=event.width_mm), ()
        case _:
            return state, ()


def _on_part_lost(state: State, event: PartLost) -> Result:
    if state.phase is Phase.CLOSING:  # it lies in its gap: releasing it is no loss
        return state, ()
    if state.phase is Phase.DESCENDING:
        return hold(replace(state, dropped=True), "part lost", event.at_s)
    if state.phase is Phase.STOPPING:
        return replace(state, dropped=True), ()
    return fail(state, "gripper", "part_lost", f"the object was lost while {state.phase}")
