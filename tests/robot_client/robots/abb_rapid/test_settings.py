import pytest
from pydantic import ValidationError

from robot_client.robots.abb_rapid.settings import Settings
from simulation.cell.emulators.abb.rapid import SILENCE_S
from tests.robot_client.shipped import is_bounded_and_as_kept


def test_requests_keep_the_guard_from_hanging_up():
    """They come at least twice within its own limit of silence."""
    assert Settings(poll_s=SILENCE_S / 2.0).poll_s == 0.05
    with pytest.raises(ValidationError, match="poll_s"):
        Settings(poll_s=SILENCE_S / 2.0 + 1e-6)


def test_what_ships_stays_and_no_time_may_be_nothing():
    is_bounded_and_as_kept(__file__, Settings())
