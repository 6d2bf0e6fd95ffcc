from robot_client.robots.abb_egm.settings import Settings
from tests.robot_client.shipped import is_bounded_and_as_kept


def test_what_ships_stays_and_no_time_may_be_nothing():
    is_bounded_and_as_kept(__file__, Settings())


def test_datagrams_come_from_the_controller_unless_another_address_is_named():
    assert Settings(rws={"url": "http://10.0.0.2"}).hosts == ("10.0.0.2", "10.0.0.2")
    assert Settings(rws={"url": "http://10.0.0.2"}, robot_host="10.0.0.9").hosts == ("10.0.0.2", "10.0.0.9")


def test_an_arm_that_is_guided_can_stand_still_in_a_descent():
    assert Settings.pauses
