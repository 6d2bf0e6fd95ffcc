from robot_client.robots.abb_rapid.settings import Settings
from tests.robot_client.shipped import is_bounded_and_as_kept


def test_what_ships_stays_and_no_time_may_be_nothing():
    is_bounded_and_as_kept(__file__, Settings())
