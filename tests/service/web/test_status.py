"""The page's data: one snapshot, the same for early and late pages."""

import asyncio
import json
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import numpy as np
import pytest
import structlog
from websockets.sync.client import connect

from robot_client.insertion.actions import cause_of
from robot_client.session.cycle import REJECTED
from service.contract import wire
from service.contract.words.causes import CAUSES
from service.decision.controllers import BeliefPicture, Command
from service.recordings.listing import Summary
from service.recordings.writer import Recorder
from service.web.page.alarms import Alarms
from service.web.page.broadcast import Broadcast
from service.web.page.playback import timeline
from service.web.page.running import Running
from service.web.page.sentences import ended, event, shift, sure
from service.web.page.status import Status
from tests.service.client import greeted
from tests.service.conftest import LiveService
from tests.service.web.test_regrasps import put_back
from tests.waiting import wait_for


def status(live: LiveService) -> dict[str, Any]:
    return httpx.get(live.url("/v1/status")).json()


def until(live: LiveService, holds: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    return wait_for(lambda: shown if holds(shown := status(live)) else None)


def first_status(live: LiveService) -> dict[str, Any]:
    """The first snapshot of a page that connects now."""
    with connect(live.url("/v1/live", "ws"), max_size=None) as page:
        while True:
            message = json.loads(page.recv(30))
            if message["kind"] == "status":
                return message["content"]


def test_a_page_opened_in_mid_attempt_says_what_goes_on(live: LiveService) -> None:
    driver = greeted(live, "middle")
    here = wire.ToolPose(x_mm=0.0, y_mm=0.0, z_mm=60.0, yaw_deg=0.0)
    driver.send(wire.Episode(insertion_id="middle", object="white_box", start=here, approach=here))
    moved = driver.attempt(1)
    driver.arms(2)
    driver.send(wire.Descending(insertion_id="middle", attempt=2))
    until(live, lambda shown: "lowering" in shown["headline"]["words"])
    shown = first_status(live)
    assert shown["headline"]["words"] == "Attempt 2 of 15: lowering the object into the gap"
    running = shown["running"]
    assert (running["object"], running["attempt"], running["gap_width_mm"]) == ("white box", 2, 56.0)
    assert running["move"]["dx_mm"] == moved.dx_mm
    where = (moved.estimate.dx_mm + moved.dx_mm, moved.estimate.dtheta_deg + moved.dtheta_deg)
    assert running["pose"] == pytest.approx(where)
    assert running["target"] is None
    driver.gives_up()
    assert until(live, lambda shown: shown["running"] is None)["last"]["words"] == "Stopped by a person"


def test_a_client_that_names_no_phase_leaves_the_page_its_state(live: LiveService) -> None:
    shown, publish = Status(live.station), live.station.hub.publish
    greeting = {"models": (), "cameras": (), "controller": "belief", "limits": live.station.settings.limits}
    publish("message", wire.ServiceHello(insertion_id="mute", **greeting))
    publish("client", wire.Arm(insertion_id="mute", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0))
    publish("robot", wire.RobotSample(at_ns=1, phase="", attempt=1))
    assert shown.snapshot()["headline"]["words"] == "Attempt 1 of 15: "
    publish("message", wire.Finished(insertion_id="mute", outcome="aborted", attempts=1, cause="operator"))
    assert status(live)["running"] is None


def test_a_state_that_cannot_be_shown_is_logged_and_the_page_gets_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.web.page.broadcast.STATUS_S", 0.01)

    def snapshot() -> dict[str, str]:
        if not failed:
            failed.append(True)
            raise IndexError("string index out of range")
        return {"words": "as before"}

    async def first() -> str:
        with Broadcast(station, status_of).page() as page:
            return await asyncio.wait_for(page.next(), 20)

    failed: list[bool] = []
    status_of: Any = SimpleNamespace(snapshot=snapshot, changes_n=0)
    hub = SimpleNamespace(frames={}, observations={})
    station: Any = SimpleNamespace(manager=SimpleNamespace(calibration=None), hub=hub, active=None)
    with structlog.testing.capture_logs() as lines:
        text = asyncio.run(first())
    assert json.loads(text) == {"kind": "status", "content": {"words": "as before"}}
    assert [(line["event"], line["log_level"]) for line in lines] == [("page", "error")]


def test_a_failure_stays_until_a_person_has_seen_it_even_over_a_restart(live: LiveService) -> None:
    driver = greeted(live, "lost")
    driver.gives_up("part_lost", "gripper: part_lost: width 3.1 mm")
    shown = until(live, lambda shown: shown["headline"]["level"] == "stop")
    assert shown["headline"]["words"] == f"Holding: {CAUSES['part_lost'].what}"
    assert shown["headline"]["detail"] == f"{CAUSES['part_lost'].remedy}\ngripper: part_lost: width 3.1 mm"
    after_restart = Status(live.station).snapshot()
    assert after_restart["headline"] == shown["headline"]
    (alarm,) = [alarm for alarm in shown["alarms"] if alarm["insertion_id"] == "lost"]
    answer = httpx.post(live.url(f"/v1/alarms/{alarm['number']}/acknowledge"))
    assert answer.json() == {"acknowledged": alarm["number"]}
    shown = status(live)
    assert shown["headline"]["level"] == "good"
    assert next(a for a in shown["alarms"] if a["number"] == alarm["number"])["acknowledged_s"]
    assert httpx.post(live.url("/v1/alarms/999/acknowledge")).status_code == 404
    elsewhere = {"Origin": "http://elsewhere.example"}
    assert httpx.post(live.url("/v1/alarms/1/acknowledge"), headers=elsewhere).status_code == 403


def test_an_object_that_is_taken_afresh_holds_nothing_up_and_its_attempts_are_counted_on(live: LiveService) -> None:
    put_back(live, "turned")
    shown = until(live, lambda shown: shown["running"] is None)
    words = "It had turned in the hand and is regrasped"
    assert shown["headline"] == {"level": "busy", "words": words, "detail": CAUSES["afresh"].remedy}
    assert [alarm for alarm in shown["alarms"] if alarm["insertion_id"] == "turned"] == []
    again = greeted(live, "again", continues="turned")
    assert until(live, lambda shown: shown["running"])["headline"]["words"].startswith("Regrasped: ")
    again.arms(1)
    shown = until(live, lambda shown: shown["headline"]["words"] == "Attempt 2 of 15: ready to go down")
    assert next(event["text"] for event in shown["events"] if "begins" in event["text"]) == "attempt 2 begins"
    again.gives_up()
    assert until(live, lambda shown: shown["running"] is None)["last"]["attempts"] == 2
    listed = {one["insertion_id"]: one for one in httpx.get(live.url("/v1/recordings")).json()["recordings"]}
    assert (listed["turned"]["outcome"], listed["turned"]["cause"]) == ("regrasped", "afresh")
    assert listed["again"]["continues"] == "turned"
    assert ended("inserted", None, 3, "rectangle", 1) == "Rectangle inserted after 3 attempts, regrasped once"
    finished = wire.Finished(insertion_id="again", outcome="inserted", attempts=2)
    assert event(finished, earlier_n=1) == "object inserted after 3 attempts", "as the headline counts"


def test_a_probe_that_is_done_is_no_alarm(live: LiveService) -> None:
    before = status(live)["alarms"]
    greeted(live, "probe").gives_up("probed", "a probe, done")
    shown = until(live, lambda shown: shown["running"] is None and shown["last"]["insertion_id"] == "probe")
    assert (shown["last"]["outcome"], shown["last"]["words"]) == ("probed", "A probe, done")
    assert (shown["alarms"], shown["headline"]["level"]) == (before, "good")


@pytest.mark.parametrize("step_s", [-3600.0, 3600.0])
def test_an_insertion_took_as_long_as_it_took_though_the_wall_clock_was_set_in_it(
    live: LiveService, monkeypatch: pytest.MonkeyPatch, step_s: float
) -> None:
    driver = greeted(live, f"set{'-back' if step_s < 0 else '-forward'}")
    shown = until(live, lambda shown: shown["running"] and shown["running"]["insertion_id"] == driver.id)
    assert 0.0 <= shown["now_s"] - shown["running"]["began_s"] < 3600.0, "seconds since 1970, as the API says"
    stepped = SimpleNamespace(time=lambda: time.time() + step_s, monotonic=time.monotonic)
    monkeypatch.setattr("service.web.page.status.time", stepped)
    driver.gives_up()
    last = until(live, lambda shown: shown["running"] is None and shown["last"]["insertion_id"] == driver.id)["last"]
    assert abs(last["at_s"] - time.time()) > 3000.0, "the clock was set"
    assert 0.0 < last["seconds"] < 60.0


@pytest.mark.parametrize("reason", REJECTED)
def test_the_page_does_not_say_that_an_arm_holds_that_may_carry_its_part_away(reason: str) -> None:
    source, code, *_ = reason.rstrip(":").split(": ")
    assert ended("failed", cause_of(source, code), 3).startswith("Not inserted: ")  # type: ignore[arg-type]
    assert ended("failed", "arm", 3).startswith("Holding: ")


def test_an_insertion_counts_as_recorded_once_it_is_listed(live: LiveService, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page reads its history anew then: as soon as an insertion has ended, a slow disk does not list it yet."""
    closes, close = threading.Event(), Recorder.close
    monkeypatch.setattr(Recorder, "close", lambda *given: closes.wait(60) and close(*given))
    driver = greeted(live, "kept")
    driver.send(wire.Abort(insertion_id="kept", cause="operator", reason="done"))
    shown = until(live, lambda shown: shown["running"] is None and shown["last"]["insertion_id"] == "kept")
    assert shown["recorded"] != "kept"
    closes.set()
    until(live, lambda shown: shown["recorded"] == "kept")
    listed = httpx.get(live.url("/v1/recordings")).json()["recordings"]
    assert "kept" in [one["insertion_id"] for one in listed]
    driver.close()


def test_the_same_alarm_counts_and_a_new_one_comes_first(tmp_path: Path) -> None:
    alarms = Alarms(tmp_path / "alarms.json")
    first = alarms.sound("camera left", "warning", "Left camera lost")
    other = alarms.sound("service", "warning", "Fault of the service")
    assert [alarm.number for alarm in alarms.open] == [other.number, first.number]
    alarms.sound("camera left", "warning", "Left camera lost")
    assert [(alarm.key, alarm.times_n) for alarm in alarms.open] == [("camera left", 2), ("service", 1)]
    alarms.acknowledge(first.number)
    again = Alarms(tmp_path / "alarms.json")
    assert [alarm.key for alarm in again.open] == ["service"]
    assert again.sound("camera left", "warning", "Left camera lost").number == 3
    assert len(Alarms(tmp_path / "alarms.json").all) == 3
    (tmp_path / "alarms.json").write_text("{")
    assert Alarms(tmp_path / "alarms.json").all == []


def test_ghosts_are_spread_as_the_belief_is() -> None:
    x, theta = np.arange(-20, 20.5, 0.5), np.arange(-20, 20.5, 0.5)
    share = np.exp(-0.5 * (((x - 5) / 2)[:, None] ** 2 + ((theta + 3) / 1)[None, :] ** 2))
    picture = BeliefPicture(x, theta, share / share.sum())
    running = Running("spread")
    running.believes(Command(0.0, 0.0, "belief", "", picture))
    mean, spread = np.mean(running.ghosts, axis=0), np.std(running.ghosts, axis=0)
    assert mean == pytest.approx([5, -3], abs=0.5)
    assert spread == pytest.approx([2, 1], abs=0.4)


def test_moves_and_confidence_are_said_in_words() -> None:
    assert shift(-4.23, 3.06) == "4.2 mm left, 3.1° anticlockwise"
    assert shift(0.0, -3.06) == "3.1° clockwise"
    assert shift(0.01, 0.0) == "nothing"
    words = ["very sure of", "fairly sure of", "unsure of", "guessing"]
    assert [sure(p) for p in (0.95, 0.75, 0.5, 0.1)] == [f"{one} the direction" for one in words]


def test_an_interval_is_judged_by_where_the_object_went_in() -> None:
    first = {"attempt": 1, "correction": (-6.0, 2.0), "interval_x_mm": (7.0, 9.0), "interval_theta_deg": (-4.0, 0.0)}
    second = {"attempt": 2, "correction": (-2.0, 0.0), "interval_x_mm": (3.0, 5.0)}
    facts = {"insertion_id": "held", "attempts": 3, "decisions": [first, second]}
    assert Summary.model_validate(facts | {"outcome": "inserted"}).held_n == (2, 3)  # 8 mm and -2 deg, but not 2 mm
    assert Summary.model_validate(facts | {"outcome": "failed"}).held_n == (0, 0)


def test_an_insertion_that_is_not_claimed_is_listed_with_every_doubt() -> None:
    doubts = tuple(wire.Doubt(reason=r, detail=d) for r, d in (("push", "the gels carry a push"), ("width", "closed")))
    how = {"outcome": "not_confirmed", "cause": "not_confirmed", "attempts": 3, "doubts": doubts}
    finished = wire.Finished(insertion_id="a", **how)
    assert event(finished) == "holding: full depth, but not shown to be in; the gels carry a push; closed"


def test_a_recording_of_another_version_is_played_back_as_far_as_it_is_understood(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, "old", {})
    opened = wire.OpenLearnt(insertion_id="old").model_dump() | {"since": 2031}
    closed = wire.Finished(insertion_id="old", outcome="failed", attempts=0, cause="arm").model_dump()
    for at_ns, message in enumerate((opened, closed)):
        recorder.message("service", message, 10**9 * at_ns)
    events = timeline(recorder.close({"outcome": "failed"}))["events"]
    assert events == [
        {"t": 0.0, "text": "open learnt, from another version of the service"},
        {"t": 1.0, "text": "holding: a fault of the arm"},
    ]


def test_a_recorded_insertion_is_played_back_on_one_time_axis(live: LiveService) -> None:
    driver = greeted(live, "played")
    decided = driver.attempt(1)
    driver.gives_up()
    (summary,) = wait_for(lambda: list(live.recordings.glob("*_played/summary.json")))
    base = f"/v1/recordings/{summary.parent.name}"
    timeline = httpx.get(live.url(f"{base}/timeline"), timeout=60).json()
    assert max(timeline["slip"]["left"][1] + timeline["slip"]["right"][1]) >= 1
    assert max(timeline["push"]["left"][1]) > 0.1
    assert f"moves {shift(decided.dx_mm, decided.dtheta_deg)}" in [event["text"] for event in timeline["events"]]
    assert [event["text"] for event in timeline["events"][-2:]] == ["done", "stopped by a person"]
    times = [moment["t"] for moment in timeline["moments"]]
    assert times == sorted(times)
    last = next(moment for moment in timeline["moments"][::-1] if moment["left"])
    felt = httpx.get(live.url(f"{base}/moments/left/{last['left']}"), timeout=60).json()
    assert (felt["width"], felt["height"]) == (327, 320)
    assert 2 in felt["kinds"]
    assert len(felt["moved"]) == 2 * len(felt["kinds"])
    for finger, at_ns in timeline["open"].items():
        unfelt = httpx.get(live.url(f"{base}/moments/{finger}/{at_ns}"), timeout=60).json()
        assert int(at_ns) <= min(int(moment[finger]) for moment in timeline["moments"] if moment[finger])
        assert (unfelt["finger"], unfelt["width"], unfelt["moved"]) == (finger, 327, [])
    assert list(timeline["open"]) == ["left", "right"]
    assert httpx.get(live.url(f"{base}/moments/left/5")).status_code == 400
    (listed,) = [r for r in httpx.get(live.url("/v1/recordings")).json()["recordings"] if r["insertion_id"] == "played"]
    assert listed["decisions"][0]["correction"] == [decided.dx_mm, decided.dtheta_deg]
    assert listed["seconds"] > 0
    again = httpx.post(live.url(f"{base}/decide"), timeout=120).json()
    assert again["same"] is True, again
