"""The perception thread's order of work: messages must not keep it from the clock."""

import itertools
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from service.cameras.capture import CameraError, CameraFrame
from service.contract import ContractError, TactileFrame
from service.decision.models import load_models
from service.session.station import TICK_S, Station
from service.settings import Settings


@pytest.fixture
def idle(tmp_path: Path, models_folder: Path) -> Iterator[Station]:
    """A station whose threads were never started: the test is its perception thread."""
    settings = Settings(models=models_folder, camera_left="push:", camera_right="push:", recordings=tmp_path)
    station = Station(settings, load_models(models_folder), None)
    yield station
    station._networks.shutdown()


def test_a_client_that_talks_all_the_time_does_not_keep_deadlines_from_being_looked_at(
    idle: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s, ticked_s = 100.0, []
    monkeypatch.setattr("service.session.station.now_ns", lambda: int(now_s * 1e9))
    monkeypatch.setattr(idle, "_tick", lambda: ticked_s.append(now_s))

    def heartbeat() -> None:
        nonlocal now_s
        now_s += 0.4 * TICK_S

    for _ in range(50):
        idle.post(heartbeat)
    idle._inbox.put(None)
    idle._run()
    assert len(ticked_s) >= 15
    assert max(b - a for a, b in itertools.pairwise(ticked_s)) <= 2 * TICK_S


def test_a_call_that_raises_is_counted_published_and_does_not_end_the_thread(
    idle: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    published, later = [], []
    monkeypatch.setattr(idle.hub, "publish", lambda kind, content: published.append((kind, content)))
    idle._ticked_ns = time.monotonic_ns() + 10**12
    for call in (lambda: {}["lost"], lambda: later.append(1)):
        idle.post(call)
    idle._inbox.put(None)
    idle._run()
    assert published == [("error", "KeyError: 'lost'")]
    assert (idle.counters.perception_errors_n, later) == (1, [1])


@pytest.mark.parametrize(
    ("left_ms", "right_ms", "age_ms"), [(3.0, 8.0, 8.0), (8.0, 3.0, 8.0), (None, 3.0, None), (None, None, None)]
)
def test_frames_are_as_old_as_those_of_the_finger_that_is_further_behind(
    idle: Station, monkeypatch: pytest.MonkeyPatch, left_ms: float | None, right_ms: float | None, age_ms: float | None
) -> None:
    now_ns = 10**10
    monkeypatch.setattr("service.session.station.now_ns", lambda: now_ns)
    stamps = {
        name: None if ms is None else now_ns - round(ms * 1e6) for name, ms in (("left", left_ms), ("right", right_ms))
    }
    idle.cameras = {name: SimpleNamespace(newest_ns=stamp_ns) for name, stamp_ns in stamps.items()}  # type: ignore[misc]
    assert idle.frame_age_ms() == age_ms


@pytest.mark.parametrize(("states", "ready"), [(("live", "live"), True), (("live", "stalled"), False)])
def test_a_station_is_ready_with_both_cameras(idle: Station, states: tuple[str, str], ready: bool) -> None:
    idle.cameras = {str(number): SimpleNamespace(state=state) for number, state in enumerate(states)}  # type: ignore[misc]
    assert idle.ready == ready


@pytest.mark.parametrize(("width_px", "accepted"), [(327, True), (640, False)])
def test_a_camera_of_another_size_is_named_with_the_size_that_is_expected(
    idle: Station, width_px: int, accepted: bool
) -> None:
    if accepted:
        idle._check_size("left", (320, width_px, 3))
        return
    with pytest.raises(CameraError, match="left camera delivers 640 x 320 frames, expected 327 x 320; raw frames need"):
        idle._check_size("left", (320, width_px, 3))


def test_a_finger_that_has_a_camera_takes_no_pushed_frames(idle: Station) -> None:
    assert idle.push("left") is idle.cameras["left"].source
    idle.cameras = {"left": SimpleNamespace(source=SimpleNamespace(name="http://x"))}  # type: ignore[misc]
    with pytest.raises(ContractError, match="start the service with --camera-left push:"):
        idle.push("left")


class Driven:
    """An insertion that wants frames or does not; ``frames`` are the frames that it was given."""

    def __init__(self, *, wants_frames: bool) -> None:
        self.wants_frames, self.frames = wants_frames, list[int]()
        self.session = SimpleNamespace(watches_slip=False)

    def frame(self, frame: CameraFrame, _pair: object) -> None:
        self.frames.append(frame.frame.seq)


def deliver(station: Station, *numbers: int) -> None:
    for seq in numbers:
        frame = TactileFrame("left", seq, seq, np.zeros((2, 2, 3), np.uint8))
        station._on_camera_frame(CameraFrame(frame, None))


@pytest.mark.parametrize("wanted", [True, False])
def test_frames_between_attempts_are_neither_perceived_nor_counted_as_dropped(
    idle: Station, monkeypatch: pytest.MonkeyPatch, wanted: bool
) -> None:
    driven = Driven(wants_frames=wanted)
    monkeypatch.setattr(idle.manager, "active", driven)
    deliver(idle, *range(1, 11))
    for _ in range(10):
        idle._next_frame()
    assert driven.frames == ([3, 4, 5, 6, 7, 8, 9, 10] if wanted else [])
    assert idle.counters.frames_dropped_n == (2 if wanted else 0)


def test_frames_that_wait_while_their_insertion_ends_go_to_no_other_and_are_no_error(
    idle: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    deliver(idle, 1)
    monkeypatch.setattr(idle.manager, "active", Driven(wants_frames=True))
    deliver(idle, 2)
    monkeypatch.setattr(idle.manager, "active", None)
    idle._inbox.put(None)
    idle._run()
    assert idle.counters.perception_errors_n == 0
    assert not idle._frames


def test_what_the_networks_found_is_heard_of_in_the_perception_thread_alone(
    idle: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    heard: list[object] = []
    monkeypatch.setattr(idle.manager, "active", SimpleNamespace(result=heard.append))
    idle._ticked_ns = time.monotonic_ns() + 10**12
    for result in (None, "the first", "the second"):
        idle._submit(SimpleNamespace(run=lambda result=result: result))  # type: ignore[arg-type]
    idle._networks.submit(int).result()
    assert heard == [], "another thread's"
    idle._inbox.put(None)
    idle._run()
    assert heard == ["the first", "the second"]
