"""Which of the cameras' frames reach the insertion under way. The test is the station's perception thread."""

from types import SimpleNamespace

import numpy as np
import pytest

from service.cameras.capture import CameraFrame
from service.contract import FINGERS, Finger, FramePair, TactileFrame
from service.session.station import Station
from tests.service.session.test_station import works_off

PIXELS = np.zeros((2, 2, 3), np.uint8)
MS = 1_000_000


def comes(station: Station, finger: Finger, seq: int, captured_ns: int = 0) -> None:
    station._on_camera_frame(CameraFrame(TactileFrame(finger, seq, captured_ns, PIXELS), b"%d" % seq))


class Insertion:
    """Stands in for the insertion under way; keeps the numbers of the frames that it is shown."""

    def __init__(
        self, station: Station, patch: pytest.MonkeyPatch, *, wants: bool = True, watches: bool = False
    ) -> None:
        self.wants_frames, self.session = wants, SimpleNamespace(watches_slip=watches)
        self.shown: list[tuple[str, int]] = []
        patch.setattr(station.manager, "active", self)

    def frame(self, frame: CameraFrame, pair: FramePair | None) -> None:
        self.shown.append((frame.frame.finger, frame.frame.seq) if pair is None else ("pair", pair.left.seq))


@pytest.mark.parametrize(("wants", "dropped_n"), [(True, 2), (False, 0)])
def test_of_more_frames_than_four_a_finger_the_oldest_are_dropped_and_counted_if_anybody_wants_them(
    idle: Station, monkeypatch: pytest.MonkeyPatch, wants: bool, dropped_n: int
) -> None:
    insertion = Insertion(idle, monkeypatch, wants=wants)
    for seq in range(10):
        comes(idle, "left", seq)
    for _ in range(12):
        idle._next_frame()
    assert insertion.shown == ([("left", seq) for seq in range(2, 10)] if wants else [])
    assert idle.counters.frames_dropped_n == dropped_n


@pytest.mark.parametrize(
    ("rate_hz", "age_ms", "waiting_n", "outdated"),
    [
        (None, 32.9, 3, False),
        (None, 33.1, 3, True),
        (60.0, 16.6, 3, False),
        (60.0, 16.7, 3, True),
        (60.0, 99.0, 2, False),
    ],
)
def test_while_slip_is_watched_a_frame_older_than_a_period_gives_way_to_a_newer_one(
    idle: Station, monkeypatch: pytest.MonkeyPatch, rate_hz: float | None, age_ms: float, waiting_n: int, outdated: bool
) -> None:
    insertion = Insertion(idle, monkeypatch, watches=True)
    monkeypatch.setattr("service.session.station.Camera.frame_rate_hz", property(lambda _: rate_hz))
    monkeypatch.setattr("service.session.station.now_ns", lambda: round(age_ms * MS))
    for seq in range(waiting_n):
        comes(idle, "left", seq, 0 if seq == 0 else 10**9)
    idle._next_frame()
    assert insertion.shown == [("left", int(outdated))]
    assert idle.counters.frames_dropped_n == outdated


def test_frames_come_in_pairs_with_their_pictures_as_long_as_a_pair_may_need_them(
    idle: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    insertion = Insertion(idle, monkeypatch)
    for seq in range(20):
        for finger in FINGERS:
            comes(idle, finger, seq, seq * 33 * MS)
            idle._next_frame()
    assert insertion.shown[-2:] == [("left", 19), ("pair", 19)]
    assert sorted(idle.manager.jpegs) == [(finger, seq) for finger in FINGERS for seq in range(4, 20)]
    assert idle.manager.jpegs["left", 19] == b"19"


def test_frames_that_wait_while_their_insertion_ends_are_shown_to_nobody_and_are_no_error(
    idle: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    insertion = Insertion(idle, monkeypatch)
    comes(idle, "left", 1)
    monkeypatch.setattr(idle.manager, "active", None)
    works_off(idle)
    assert (insertion.shown, len(idle._frames), idle.counters.perception_errors_n) == ([], 0, 0)


def test_without_an_insertion_frames_are_only_shown_and_attended_if_somebody_looks(
    idle: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    comes(idle, "left", 1)
    assert (idle.manager.jpegs, len(idle._frames), idle.hub.frames["left"].frame.seq) == ({}, 0, 1)
    assert not idle._attends()
    idle.viewers_n = 1
    assert idle._attends()
    idle.viewers_n = 0
    Insertion(idle, monkeypatch)
    assert idle._attends()
