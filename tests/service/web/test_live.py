import gc
import json
import re
import statistics
import time
import weakref
from pathlib import Path

import httpx
import numpy as np
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from service.contract import wire
from tests.service.client import Driver, greeted
from tests.service.conftest import LiveService
from tests.waiting import wait_for


def test_a_whole_insertion_with_corrections_is_answered_and_recorded(live: LiveService) -> None:
    driver = Driver(live, "whole")
    hello = driver.until("hello")
    assert {entry.card.role for entry in hello.models} == {"direction", "magnitude"}
    assert [camera.state for camera in hello.cameras] == ["live", "live"]
    corrections = [driver.attempt(number) for number in (1, 2)]
    assert all(c.latency_ms["since_last_frame"] > 0 for c in corrections)
    finished = driver.insert(3)
    assert (finished.outcome, finished.attempts) == ("inserted", 3)
    assert finished.recording is not None
    folder = Path(finished.recording).parent
    assert (folder / "insertion.mcap").stat().st_size > 100_000
    assert json.loads((folder / "summary.json").read_text())["outcome"] == "inserted"
    with np.load(folder / "attempt_01.npz") as arrays:
        assert arrays["frames"].shape == (8, 2, 320, 327, 3)
        decision = wire.parse_service(str(arrays["decision"]))
    assert decision == corrections[0]


def test_an_ended_insertion_is_freed_at_once(live: LiveService) -> None:
    gc.collect()
    gc.disable()
    try:
        driver = greeted(live, "freed")
        driver.attempt(1)
        session = weakref.ref(live.station.active.session.left)
        driver.gives_up()
        wait_for(lambda: session() is None)
    finally:
        gc.enable()


def test_health_ready_and_metrics_answer(live: LiveService) -> None:
    assert httpx.get(live.url("/healthz")).json() == {"status": "ok"}
    assert httpx.get(live.url("/readyz")).status_code == 200
    text = live.metrics()
    assert 'tactile_frames_total{finger="left"}' in text
    assert "tactile_ready 1.0" in text
    assert 'tactile_internal_errors{where="perception"} 0.0' in text


def metrics_of(live: LiveService, named: str) -> dict[str, float]:
    """The values of the metrics whose name this expression matches, by its group."""
    return {what: float(n) for what, n in re.findall(rf"^{named} (\S+)$", live.metrics(), re.MULTILINE)}


def timed(live: LiveService) -> dict[str, float]:
    """How many stops were timed from their frames to their messages, and their seconds."""
    return metrics_of(live, "tactile_slip_age_seconds_(count|sum)")


def test_a_stop_is_timed_whether_by_slip_or_because_the_networks_have_seen_enough(live: LiveService) -> None:
    """Of the released networks nearly every stop is the latter."""
    before = timed(live)
    driver = greeted(live, "timed")
    driver.attempt(1)
    slid = timed(live)
    assert slid["count"] == before["count"] + 1
    at_ns = time.monotonic_ns() - 3 * 10**9
    enough = wire.Enough(insertion_id="timed", attempt=1, frame_seq=1, captured_ns=at_ns, pressed_mm=0.8)
    live.station.post(lambda: live.station.active._emit([enough], at_ns))
    assert driver.until("enough") == enough
    pressed = wait_for(lambda: (now := timed(live))["count"] > slid["count"] and now)
    assert pressed["count"] == slid["count"] + 1
    assert 3.0 < pressed["sum"] - slid["sum"] < 60.0
    driver.gives_up()


def test_metrics_are_made_ten_times_a_second_at_most(live: LiveService, monkeypatch: pytest.MonkeyPatch) -> None:
    """A flood of scrapes, which need no token, must not hold up the robot's messages."""
    time.sleep(0.5)  # what was made before is old, and for who comes after so is what is made here
    begun_ns, texts = time.monotonic_ns() - 350_000_000, []
    for at_ns in (begun_ns, begun_ns + 99_000_000, begun_ns + 101_000_000):
        monkeypatch.setattr("service.web.metrics.now_ns", lambda at_ns=at_ns: at_ns)
        texts.append({httpx.get(live.url("/metrics")).text for _ in range(5)})
    assert [len(same) for same in texts] == [1, 1, 1]
    assert texts[0] == texts[1] != texts[2]


def test_only_one_client_drives_and_others_watch(live: LiveService) -> None:
    driver, second, watcher = Driver(live, "first"), None, None
    try:
        driver.until("hello")
        second = Driver(live, "second")
        fault = second.receive()
        assert (fault.type, fault.code, fault.fatal) == ("fault", "busy", True)
        watcher = Driver(live, "watcher", role="watch", sent_ns=7)
        assert watcher.receive().clock.sent_ns == 7
        watcher.send(wire.Descending(insertion_id="watcher", attempt=1))
        assert watcher.receive().code == "watch_only"
        for garbage in ("{", b"binary"):
            watcher.socket.send(garbage)
            fault = watcher.receive()
            assert (fault.code, fault.fatal) == ("bad_message", False), "it goes on watching"
        driver.attempt(1)
        assert watcher.until("correction").insertion_id == "first"
        driver.send(wire.Abort(insertion_id="first", cause="operator", reason="done"))
        assert driver.until("finished").outcome == "aborted"
    finally:
        for client in (driver, second, watcher):
            if client:
                client.close()


def refused_n(live: LiveService) -> dict[str, float]:
    """How many clients were refused so far, by why."""
    return metrics_of(live, r'tactile_clients_refused_total{code="(\w+)"}')


def test_a_client_that_is_turned_away_is_counted_by_why(live: LiveService) -> None:
    before = refused_n(live)
    driver = greeted(live, "driving")
    for code, hello in {"busy": {}, "protocol_version": {"protocol": 1}}.items():
        other = Driver(live, "other", **hello)
        assert other.receive().code == code
        other.close()
    with connect(live.url("/v1/insertion", "ws")) as nobody:
        nobody.send(wire.ClientHello(insertion_id="other", client="test").model_dump_json())
        assert wire.parse_service(nobody.recv(20)).code == "forbidden"
    driver.gives_up()
    changed = {code: n - before[code] for code, n in refused_n(live).items() if n != before[code]}
    assert changed == {"busy": 1, "protocol_version": 1, "forbidden": 1}


def test_a_client_that_could_be_no_robot_is_turned_away_and_not_counted(live: LiveService) -> None:
    """Two of them in ten minutes would page to stop packing; behind a wrong token, though, a robot may be."""
    before, path = refused_n(live), live.url("/v1/insertion", "ws")
    hello = {"type": "hello", "insertion_id": "watcher", "role": "watch"}  # and not which client it is
    for protocol, code in ((1, "protocol_version"), (wire.PROTOCOL, "bad_message")):
        with connect(path) as watcher:
            watcher.send(json.dumps(hello | {"protocol": protocol}))
            assert wire.parse_service(watcher.recv(20)).code == code
    for token in (live.token, "wrong"):
        with pytest.raises(InvalidStatus, match="403"), connect(f"{path}?token={token}", origin="http://elsewhere"):
            pass
    assert refused_n(live) == before
    with pytest.raises(InvalidStatus, match="403"), connect(f"{path}?token=wrong"):
        pass
    assert refused_n(live) == before | {"forbidden": before["forbidden"] + 1}


def test_garbage_is_answered_by_a_fault_and_the_insertion_goes_on(live: LiveService) -> None:
    driver = greeted(live, "garbled")
    for garbage in ("{", '{"type": "arm"}', "[]", '{"type": "dance", "insertion_id": "garbled"}'):
        driver.socket.send(garbage)
        assert driver.receive().code == "bad_message"
    driver.socket.send(b"\0" * 100)
    assert driver.receive().code == "bad_message"
    driver.attempt(1)
    driver.gives_up()


def test_a_client_that_lost_its_connection_takes_its_insertion_up_again(live: LiveService) -> None:
    driver = greeted(live, "resumed")
    driver.attempt(1)
    driver.close()
    time.sleep(0.1)
    again = greeted(live, "resumed")
    again.attempt(2)
    assert again.gives_up().attempts == 2


def test_a_client_that_is_gone_makes_room_for_the_next_one_at_once(live: LiveService) -> None:
    gone = greeted(live, "gone")
    gone.attempt(1)
    gone.close()
    # the service gives a silent client up after 60 s: this must not be what helps
    wait_for(lambda: live.station.active is not None and live.station.active.send is None, 50.0)
    following = Driver(live, "following")
    assert following.until("hello").insertion_id == "following"
    following.gives_up()
    (path,) = wait_for(lambda: list(live.recordings.glob("*_gone/summary.json")), 50.0)  # closed beside the next one
    summary = json.loads(path.read_text())
    assert (summary["outcome"], summary["attempts"]) == ("failed", 1)


@pytest.mark.slow
def test_a_camera_that_returns_is_found_within_a_second(live: LiveService) -> None:
    """The median of seven cuts, because the machine may be busy; the pause between tries is tested by itself."""
    taken = []
    for _ in range(7):
        live.fingers[0].connected = False
        wait_for(lambda: not live.station.ready)
        time.sleep(0.5)
        live.fingers[0].connected = True
        returned_s = time.monotonic()
        wait_for(lambda: live.station.ready)
        taken.append(time.monotonic() - returned_s)
    assert statistics.median(taken) < 1.0


def test_a_cut_camera_is_a_fault_and_comes_back(live: LiveService) -> None:
    left = live.fingers[0]
    driver = greeted(live, "cut")
    driver.arms(1)
    left.connected = False
    while (fault := driver.receive()).type == "watching":  # frames that were on their way
        pass
    assert (fault.code, fault.fatal) == ("camera_lost", False)
    assert httpx.get(live.url("/readyz")).status_code == 503
    left.connected = True
    wait_for(lambda: live.station.ready, 50.0)
    driver.send(wire.Stopped(insertion_id="cut", attempt=1, depth_mm=3.0, outcome="blocked"))
    refused = driver.receive()
    assert (refused.type, refused.reason) == ("no_decision", "stale")
    driver.gives_up()
