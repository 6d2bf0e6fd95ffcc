"""Silence counts only while this process could have received: its own stalls are not the link's."""

from hypothesis import given
from hypothesis import strategies as st

from robot_client.silence import Silence


def test_silence_beyond_the_bound_is_reported():
    silence = Silence(0.25, 0.05)
    silence.heard(0.0)
    reported = [silence.over(i * 0.05) for i in range(1, 12)]
    assert reported[:5] == [None] * 5
    assert reported[5] is not None


def test_a_stall_of_this_process_is_not_silence_of_the_other():
    silence = Silence(0.25, 0.05)
    silence.heard(0.0)
    assert silence.over(0.05) is None
    assert silence.over(5.0) is None
    assert [silence.over(5.0 + i * 0.05) for i in range(1, 8)][-1] is not None, "but it does not excuse for ever"


def test_nothing_is_reported_before_something_was_heard():
    assert Silence(0.25, 0.05).over(100.0) is None


@given(st.lists(st.floats(0.001, 0.1), min_size=40, max_size=80))
def test_no_rhythm_of_asking_hides_a_lost_link(steps):
    silence, now, reported = Silence(0.25, 0.05), 0.0, False
    silence.heard(0.0)
    for step in [*steps, *[0.05] * 10]:
        now += step
        reported = reported or silence.over(now) is not None
    assert reported
