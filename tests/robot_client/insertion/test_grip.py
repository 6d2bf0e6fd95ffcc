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
