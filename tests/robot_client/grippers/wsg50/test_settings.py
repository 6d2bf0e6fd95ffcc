import pytest
from pydantic import ValidationError

from robot_client.grippers.wsg50.settings import Settings
from tests.robot_client.shipped import is_bounded_and_as_kept


def test_what_ships_stays_and_no_time_may_be_nothing():
    is_bounded_and_as_kept(__file__, Settings())


@pytest.mark.parametrize(("period_ms", "allowed"), [(9, False), (10, True), (200, True), (201, False)])
def test_the_gripper_sends_its_state_a_hundred_times_to_five_times_a_second(period_ms, allowed):
    if allowed:
        assert Settings(update_period_ms=period_ms).update_period_ms == period_ms
    else:
        with pytest.raises(ValidationError, match="update_period_ms"):
            Settings(update_period_ms=period_ms)
