import pytest
from pydantic import ValidationError

from robot_client.grippers.wsg50.settings import Settings
from tests.robot_client.shipped import is_bounded_and_as_kept


def test_what_ships_stays_and_no_time_may_be_nothing():
    is_bounded_and_as_kept(__file__, Settings(), silence_s=0.04)


@pytest.mark.parametrize(("period_ms", "allowed"), [(9, False), (10, True), (200, True), (201, False)])
def test_the_gripper_sends_its_state_a_hundred_times_to_five_times_a_second(period_ms, allowed):
    if allowed:
        assert Settings(update_period_ms=period_ms).update_period_ms == period_ms
        assert Settings(update_period_ms=period_ms, silence_s=2e-3 * period_ms).silence_s == 2e-3 * period_ms
        with pytest.raises(ValidationError, match=r"silence_s = .*, expected at least two update periods"):
            Settings(update_period_ms=period_ms, silence_s=1.99e-3 * period_ms)
    else:
        with pytest.raises(ValidationError, match="update_period_ms"):
            Settings(update_period_ms=period_ms)
