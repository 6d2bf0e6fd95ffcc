"""More frames than can be perceived: the newest win, and slip is judged on recent frames. In simulated time."""

from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.cameras.capture import CameraFrame
from service.contract import FINGERS, FramePair, TactileFrame
from service.decision.models import ModelSet
from service.session.station import Station
from service.settings import Settings

PIXELS = np.zeros((2, 2, 3), np.uint8)
MS = 1_000_000


@pytest.fixture(scope="module")
def idle(tmp_path_factory: pytest.TempPathFactory, models: ModelSet) -> Iterator[Station]:
    """A station whose threads were never started: the test is its clock and its perception thread."""
    folder = tmp_path_factory.mktemp("overload")
    settings = Settings(models=folder, camera_left="push:", camera_right="push:", recordings=folder)
    station = Station(settings, models, None)
    yield station
    station._networks.shutdown()


class Clock:
    """Time and the single perception thread: a frame costs ``step_ns``; frames arriving meanwhile wait."""

    def __init__(self, station: Station, step_ns: int, *, watches_slip: bool) -> None:
        self.now_ns, self.step_ns, self.station = 0, step_ns, station
        self.ages: list[int] = []
        self.session = SimpleNamespace(watches_slip=watches_slip)
        self.wants_frames = True
        self.arrivals: list[tuple[int, str, int]] = []

    def frame(self, frame: CameraFrame, pair: FramePair | None) -> None:
        del pair
        self.pass_time(self.step_ns)
        self.ages.append(self.now_ns - frame.frame.captured_ns)

    def pass_time(self, ns: int) -> None:
        self.now_ns += ns
        while self.arrivals and self.arrivals[0][0] <= self.now_ns:
            stamp, finger, seq = self.arrivals.pop(0)
            self.station._on_camera_frame(CameraFrame(TactileFrame(finger, seq, stamp, PIXELS), None))

    def tick(self, *_: object) -> None:
        """Deadlines are not tested here."""


def perceive(station: Station, period_ns: int, step_ns: int, *, watches_slip: bool = True) -> list[int]:
    """Ages in ns of every frame at the moment it was perceived, over 300 frame periods."""
    clock = Clock(station, step_ns, watches_slip=watches_slip)
    clock.arrivals = [(i * period_ns, finger, i) for i in range(1, 300) for finger in FINGERS]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("service.session.station.now_ns", lambda: clock.now_ns)
        patch.setattr("service.session.station.Camera.frame_rate_hz", property(lambda _: 1e9 / period_ns))
        patch.setattr(station.manager, "active", clock)
        patch.setattr(station, "_tick_if_due", lambda: None)
        station._frames.clear()
        while clock.arrivals or station._frames:
            if station._frames:
                station._next_frame()
            else:
                clock.pass_time(clock.arrivals[0][0] - clock.now_ns)
    return clock.ages


@given(period_ms=st.integers(8, 40), overload=st.floats(0.2, 6.0))
def test_a_result_is_never_older_than_a_frame_and_a_step(idle: Station, period_ms: int, overload: float) -> None:
    period_ns = period_ms * MS
    step_ns = int(overload * period_ns / 2)  # a pair costs two steps
    ages = perceive(idle, period_ns, step_ns)
    assert max(ages[:-2]) <= period_ns + step_ns
    assert len(ages) >= 0.9 * min(598, 300 * period_ns / step_ns)


def test_without_overload_no_frame_is_dropped(idle: Station) -> None:
    before = idle.counters.frames_dropped_n
    assert len(perceive(idle, 16 * MS, 3 * MS)) == 598
    assert idle.counters.frames_dropped_n == before


def test_while_the_arm_stands_still_a_late_frame_is_still_used(idle: Station) -> None:
    """A short stall costs no frame of the decision; the backlog alone bounds it."""
    strict = perceive(idle, 16 * MS, 12 * MS)
    patient = perceive(idle, 16 * MS, 12 * MS, watches_slip=False)
    assert max(patient) > max(strict)
    assert max(patient) <= 16 * MS * 8 + 12 * MS * 8
