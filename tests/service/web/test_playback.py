"""What a recording shows when it is played back: both fingers, the curves and the events, at one moment."""

from service.recordings.schemas import Markers
from service.web.page.playback import Curves


def test_both_fingers_are_played_back_as_they_were_at_the_same_time() -> None:
    """The right camera is 1 ms ahead: after an attempt's last picture its next one is of the attempt that follows."""
    pair = Markers(rows=1, cols=2, rest_px=[0, 0, 20, 0], displacement_px=[0] * 4, valid=b"\1\1").SerializeToString()
    curves = Curves()
    for at_ms in (0, 60, 120, 9000, 9060):
        curves.markers("left", at_ms * 1_000_000, pair)
        curves.markers("right", (at_ms - 1) * 1_000_000, pair)
    stamps_ms = [(int(one["left"]) // 10**6, int(one["right"]) // 10**6) for one in curves.as_json()["moments"]]
    assert stamps_ms == [(0, -1), (60, 59), (120, 119), (9000, 8999), (9060, 9059)]
