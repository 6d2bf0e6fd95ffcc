"""What the gripper tells before and after it closes."""

import pytest

from robot_client.insertion.events import Grasped, Send, Width
from robot_client.insertion.machine import Phase
from service.contract import wire
from tests.robot_client.insertion.stories import ID, TO_ARMING, hello, run, service


@pytest.mark.parametrize(
    ("stood_mm", "held", "forgets"), [(50.2, False, True), (50.4, False, False), (50.0, True, False)]
)
def test_fingers_that_were_on_the_object_all_the_time_showed_no_open_gels(stood_mm, held, forgets):
    begin = TO_ARMING[0].model_copy(update={"held": held})
    learnt = [] if held else [service(wire.OpenLearnt(insertion_id=ID))]
    width = Width(at_s=0.0, width_mm=stood_mm)
    state, commands = run([begin, service(hello()), width, *learnt, Grasped(at_s=0.0, width_mm=50.0)])
    asked = [c.message.forget for c in commands if isinstance(c, Send) and c.message.type == "learn_open"]
    assert asked == [False] * (not held) + [True] * forgets
    assert state.phase is Phase.APPROACHING


def test_a_width_slightly_below_nothing_is_reported_as_nothing():
    """A gripper is inaccurate by some hundredths, and no width of a message is negative."""
    narrow = [
        event.model_copy(update={"width_mm": -0.02}) if isinstance(event, Grasped) else event for event in TO_ARMING
    ]
    state, (*_, arm) = run([*narrow[:-1], Width(at_s=0.0, width_mm=-0.03), narrow[-1]])
    assert (state.phase, arm.message.gripper_width_mm) == (Phase.ARMING, 0.0)


@pytest.mark.parametrize(("width_mm", "is_one"), [(-1.0, True), (-1.1, False), (1000.0, True), (1000.1, False)])
@pytest.mark.parametrize("kind", [Grasped, Width])
def test_a_width_that_no_fingers_have_ends_the_insertion_and_is_named(kind, width_mm, is_one):
    """As of a driver that tells its gripper's own counts; the next message to the service could not hold it."""
    event = kind(at_s=0.0, width_mm=width_mm)
    story = [*TO_ARMING[:2], event, *TO_ARMING[3:]] if kind is Grasped else [*TO_ARMING[:-1], event, TO_ARMING[-1]]
    state, _ = run(story)
    assert (state.phase is Phase.ARMING) == is_one
    assert is_one or f"gripper: width: tells a width of {width_mm:g} mm" in state.reason


OTHER_GEL = service(wire.Fault(insertion_id=ID, code="open_gel", detail="this is not the gel", fatal=False))


@pytest.mark.parametrize(
    ("width", "apart"), [([], "if its fingers are"), ([80.04], "if its fingers, 80.0 mm apart, are")]
)
def test_the_operator_is_told_that_a_forgotten_part_may_be_why_no_open_gel_is_seen(width, apart):
    widths = [Width(at_s=0.0, width_mm=width_mm) for width_mm in width]
    forgotten = TO_ARMING[0].model_copy(update={"held": False})
    state, commands = run([forgotten, service(hello()), *widths, OTHER_GEL])
    assert state.phase is Phase.FAILED
    assert not any(command.kind == "grasp" for command in commands), "what is no open gel is not grasped"
    assert state.reason.startswith("service: open_gel: this is not the gel; the gripper reports no part")
    assert apart in state.reason
    assert "home --live --config FILE --direction outward" in state.reason


def test_a_fault_after_the_grasp_says_nothing_of_a_forgotten_part():
    state, _ = run([*TO_ARMING, OTHER_GEL])
    assert state.reason == "service: open_gel: this is not the gel"
