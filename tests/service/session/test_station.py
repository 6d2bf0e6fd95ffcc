"""The perception thread's order of work: messages must not keep it from the clock."""

import itertools
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.cameras.capture import CameraError, CameraFrame, Capture
from service.contract import ContractError, TactileFrame
from service.decision.models import ModelSet
from service.decision.work import Work
from service.session.manager import InsertionManager
from service.session.station import TICK_S, Station, open_station
from service.settings import Settings
from service.versions.versions import Versions
from tests.service import drawn


def works_off(station: Station) -> None:
    """Do what is waiting, as the perception thread does."""
    station._inbox.put(None)
    station._run()


def test_a_client_that_talks_all_the_time_does_not_keep_deadlines_from_being_looked_at(
    idle: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s, ticked_s = 100.0, []
    monkeypatch.setattr("service.session.station.now_ns", lambda: int(now_s * 1e9))
    idle._ticked_ns = 0
    monkeypatch.setattr(idle, "_tick", lambda: ticked_s.append(now_s))

    def heartbeat() -> None:
        nonlocal now_s
        now_s += 0.4 * TICK_S

    for _ in range(50):
        idle.post(heartbeat)
    works_off(idle)
    assert len(ticked_s) >= 15
    assert max(b - a for a, b in itertools.pairwise(ticked_s)) <= 2 * TICK_S


def test_a_call_that_raises_is_counted_published_and_does_not_end_the_thread(
    idle: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    published, later = [], []
    monkeypatch.setattr(idle.hub, "publish", lambda kind, content: published.append((kind, content)))
    for call in (lambda: {}["lost"], lambda: later.append(1)):
        idle.post(call)
    works_off(idle)
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


def test_a_station_whose_thread_does_nothing_for_5_s_is_not_ready_and_says_so(
    idle: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 100.0
    monkeypatch.setattr("service.session.station.now_ns", lambda: round(now_s * 1e9))
    idle._ticked_ns, live = 0, SimpleNamespace(state="live", check_stall=lambda _: None)
    idle.cameras = {"left": live, "right": live}  # type: ignore[dict-item]
    for ready in (True, False, True):
        idle.post(lambda: None)
        works_off(idle)
        assert (idle.ready, idle.standstill) == (True, "")
        now_s += 4.9 if ready else 12.0
        assert idle.ready == ready
        assert idle.standstill == ("" if ready else "no frame is judged and no client answered for 12 s")


def test_a_camera_of_another_size_is_not_live_and_is_named_with_the_size_that_is_expected(
    idle: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whenever its pictures begin to come: every insertion would be refused while the service says that it is ready."""
    published = []
    monkeypatch.setattr(idle.hub, "publish", lambda kind, content: published.append((kind, content)))
    rng = np.random.default_rng(0)
    for stamp_ns, width_px in enumerate((640, 640, 327, 640), 1):
        pixels = rng.integers(0, 255, (320, width_px, 3), np.uint8)
        for camera in idle.cameras.values():
            camera._publish(Capture(stamp_ns, pixels))
        assert idle.ready == (width_px == 327)
    fault = "left camera delivers 640 x 320 frames, expected 327 x 320; raw frames need --calibration FILE"
    assert idle.cameras["left"].last_fault.startswith(fault)
    codes = [content["code"] for kind, content in published if kind == "camera_fault" and content["finger"] == "left"]
    assert codes == ["camera_size"] * 2, "once for each time that the size became wrong"


@pytest.mark.parametrize(("asked_hz", "rate_hz"), [(None, 30.0), (90.0, 90.0)])
def test_cameras_are_asked_for_the_rate_that_is_set_or_else_the_sensors(
    tmp_path: Path, models: ModelSet, monkeypatch: pytest.MonkeyPatch, asked_hz: float | None, rate_hz: float
) -> None:
    asked: list[tuple[str, float]] = []
    monkeypatch.setattr(
        "service.session.station.open_source",
        lambda url, *, frame_rate_hz: asked.append((url, frame_rate_hz)) or SimpleNamespace(name=url),
    )
    settings = Settings(
        models=tmp_path, camera_left="push:a", camera_right="push:b", recordings=tmp_path, frame_rate_hz=asked_hz
    )
    Station(settings, models, None)._networks.shutdown()
    assert (models.card.profile.fps, asked) == (30.0, [("push:a", rate_hz), ("push:b", rate_hz)])


def test_networks_are_rehearsed_before_the_service_is_ready_with_or_without_pictures(
    idle: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    rehearsed: list[list[str]] = []
    monkeypatch.setattr(
        "service.session.station.warm_up", lambda _, frames: rehearsed.append([frame.finger for frame in frames])
    )
    clock_s = itertools.count(0.0, 0.5)
    monkeypatch.setattr("service.session.station.now_ns", lambda: round(next(clock_s) * 1e9))
    idle.wait_for_cameras(2.0)
    assert (rehearsed, next(clock_s)) == ([[]], 3.0), "cameras that show nothing are waited for, in vain"
    big = np.zeros((320, 327, 3), np.uint8)
    for finger, camera in idle.cameras.items():
        camera.latest = CameraFrame(TactileFrame(finger, 0, 0, big), None)
    idle.wait_for_cameras(2.0)
    assert rehearsed == [[], ["left", "right"]]
    idle.cameras["right"].latest = None
    idle.cameras["right"]._publish(Capture(1, big[:2, :2]))
    with pytest.raises(CameraError, match="right camera delivers 2 x 2 frames"):
        idle.wait_for_cameras(2.0)


def test_with_a_calibration_a_camera_may_be_raw_or_rectified(idle: Station) -> None:
    idle.manager.calibration = drawn.calibration()
    for width_px in (327, 427):
        assert idle._size_fault("left", (320, width_px, 3)) is None
    assert "expected 327 x 320 or 427 x 320; set the camera to it" in str(idle._size_fault("left", (480, 640, 3)))


def test_a_cameras_fault_is_shown_and_told_to_the_insertion(idle: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    shown, heard = [], []
    monkeypatch.setattr(idle.hub, "publish", lambda kind, content: shown.append((kind, content)))
    monkeypatch.setattr(InsertionManager, "fault", lambda _, code, detail: heard.append((code, detail)))
    idle._on_camera_fault("left", "camera_lost", "gone")
    works_off(idle)
    assert shown == [("camera_fault", {"finger": "left", "code": "camera_lost", "detail": "gone"})]
    assert heard == [("camera_lost", "gone")]


def test_the_networks_answers_come_back_through_the_perception_thread_where_there_are_any(
    idle: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    heard: list[Any] = []
    monkeypatch.setattr(InsertionManager, "result", lambda _, result: heard.append(result))
    for answer in (None, "evidence"):
        idle._do(Work(lambda answer=answer: answer))  # type: ignore[misc, arg-type]
    assert heard == []
    works_off(idle)
    assert heard == ["evidence"]


def test_a_tick_looks_at_both_cameras_and_at_the_insertion(idle: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[Any] = []
    monkeypatch.setattr("service.session.station.now_ns", lambda: 7 * 10**9)
    monkeypatch.setattr(
        "service.session.station.Camera.check_stall", lambda camera, at: looked.append((camera.finger, at))
    )
    monkeypatch.setattr(InsertionManager, "tick", lambda _, at_ns: looked.append(at_ns))
    idle._tick()
    assert looked == [("left", 7 * 10**9), ("right", 7 * 10**9), 7 * 10**9]


@pytest.mark.parametrize("shadow", [False, True])
def test_a_station_makes_its_folder_and_gives_its_shadow_a_place(
    tmp_path: Path, models_folder: Path, monkeypatch: pytest.MonkeyPatch, shadow: bool
) -> None:
    given: list[tuple[Path, bool]] = []
    monkeypatch.setattr(Versions, "give", lambda _, folder, *, at_start: given.append((folder, at_start)))
    settings = Settings(
        models=models_folder,
        camera_left="push:",
        camera_right="push:",
        recordings=tmp_path / "made" / "anew",
        state=tmp_path,
        shadow=tmp_path if shadow else None,
    )
    for _ in range(2):
        station = open_station(settings)
        station._networks.shutdown()
        assert station.owned is not None
        station.owned.close()
    assert settings.recordings.is_dir()
    assert given == [(tmp_path, True)] * 2 * shadow


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("327, 320", "320, 240"), r"c\.toml rectifies to \(320, 240\) .* expect \(327, 320\): .*\(gelslim_2019\)"),
        (("mm_per_px = 0.07", "mm_per_px = 0.06"), r"c\.toml rectifies to 0\.06 mm per px, the models expect 0\.07: "),
    ],
)
def test_a_calibration_for_other_networks_is_refused_with_both_frames(
    tmp_path: Path, models_folder: Path, change: tuple[str, str], message: str
) -> None:
    path = tmp_path / "c.toml"
    drawn.calibration().save(path)
    path.write_text(path.read_text().replace(*change))
    settings = Settings(
        models=models_folder, camera_left="push:", camera_right="push:", recordings=tmp_path, calibration=path
    )
    with pytest.raises(ContractError, match=message):
        open_station(settings)
