"""An object that is put back and regrasped, as the page counts and tells it, also over a restart of the service."""

import json
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import pytest

from service.contract import wire
from service.recordings.listing import list_recordings
from service.web.page.past import newest
from service.web.page.status import Status
from tests.service.client import greeted
from tests.service.conftest import LiveService
from tests.waiting import wait_for

DOUBT = wire.Doubt(reason="moved_in_hand", detail="it turned on its way in")
HOLDING = {"level": "stop", "words": "Holding: the object was to be regrasped"}
REGRASPED = {"level": "busy", "words": "It had turned in the hand and is regrasped"}


def put_back(live: LiveService, name: str, cause: wire.Cause = "afresh", **hello: Any) -> None:
    """An insertion of two attempts, the second one refused before the descent."""
    driver = greeted(live, name, **hello)
    driver.attempt(1)
    driver.arms(2)
    driver.gives_up(cause, "service: refused: turned_in_hand: by about 1.4 deg")


def headline(status: Status) -> dict[str, str]:
    return {key: status.snapshot()["headline"][key] for key in ("level", "words")}


def test_a_restart_while_the_object_is_on_its_way_is_told_as_what_it_is(live: LiveService) -> None:
    put_back(live, "first")
    put_back(live, "second", continues="first")
    restarted = Status(live.station)
    assert headline(restarted) == REGRASPED
    third = greeted(live, "third", continues="second")
    third.arms(1)
    ready = {"level": "busy", "words": "Attempt 3 of 15: ready to go down"}
    wait_for(lambda: headline(restarted) == ready)  # the page hears after the client
    third.gives_up()
    wait_for(lambda: headline(restarted) == {"level": "good", "words": "Ready for the next object"})
    assert restarted.snapshot()["last"]["attempts"] == 3


def test_an_object_that_a_person_puts_back_is_counted_on_as_one_that_the_arm_regrasps(
    live: LiveService, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before and after a restart, in the history and in the playback; a person may take any time for it."""
    page = Status(live.station)
    put_back(live, "by-hand", "refused")
    wait_for(lambda: headline(page)["level"] == "stop")
    monkeypatch.setattr("service.web.page.status.AFRESH_S", 0.0)
    pages = page, Status(live.station)
    for one in (*pages, live):
        shown = one.snapshot() if isinstance(one, Status) else httpx.get(live.url("/v1/status")).json()
        (alarm,) = [alarm for alarm in shown["alarms"] if alarm["insertion_id"] == "by-hand"]
        assert alarm["title"] != HOLDING["words"], "nothing is overdue"
    for one in pages:
        assert one.acknowledge(alarm["number"])
    httpx.post(live.url(f"/v1/alarms/{alarm['number']}/acknowledge")).raise_for_status()
    again = greeted(live, "by-hand-again", continues="by-hand")
    again.insert(1)
    again.close()
    words = "Object inserted after 2 attempts, regrasped once"
    wait_for(lambda: [one.snapshot()["last"]["words"] for one in pages] == [words, words])
    wait_for(lambda: httpx.get(live.url("/v1/status")).json()["recorded"] == "by-hand-again")
    assert Status(live.station).snapshot()["last"]["words"] == words
    listed = list_recordings(live.recordings, 1)[0][0]
    address = live.url(f"/v1/recordings/{listed['name']}/timeline")
    texts = [event["text"] for event in httpx.get(address, params={"earlier_n": 1}).json()["events"]]
    assert texts[-2:] == ["attempt 2 begins", "object inserted after 2 attempts"]


@pytest.mark.parametrize("step_s", [-3600.0, 3600.0])
def test_a_clock_that_is_set_neither_hurries_nor_delays_a_regrasp(
    live: LiveService, monkeypatch: pytest.MonkeyPatch, step_s: float
) -> None:
    shown = Status(live.station)
    put_back(live, f"stepped{step_s:+.0f}".replace("+", "on").replace("-", "back"))
    wait_for(lambda: headline(shown) == REGRASPED)
    stepped = SimpleNamespace(time=lambda: time.time() + step_s, monotonic=time.monotonic)
    monkeypatch.setattr("service.web.page.status.time", stepped)
    assert headline(shown) == REGRASPED
    if step_s < 0.0:
        restarted = Status(live.station)
        assert headline(restarted) == REGRASPED
        monkeypatch.setattr("service.web.page.status.AFRESH_S", 0.0)
        assert headline(restarted)["level"] == "stop"
        assert restarted.acknowledge(restarted.snapshot()["alarms"][0]["number"])


def test_a_regrasp_that_comes_late_is_an_alarm_and_counted_on_whether_or_not_a_page_is_open(
    live: LiveService, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An arm at reduced speed takes longer than is waited for. The service's own status is asked by nobody before."""
    open_page = Status(live.station)
    put_back(live, "slow")
    wait_for(lambda: headline(open_page) == REGRASPED)
    monkeypatch.setattr("service.web.page.status.AFRESH_S", 0.0)
    assert headline(open_page) == HOLDING
    time.sleep(1.0)
    again = greeted(live, "slow-again", continues="slow")
    again.arms(1)
    sounded_s, counted_on = [], "Attempt 2 of 15: ready to go down"
    for ask in (open_page.snapshot, lambda: httpx.get(live.url("/v1/status")).json()):
        wait_for(lambda ask=ask: ask()["headline"]["words"] == counted_on)
        (alarm,) = [alarm for alarm in ask()["alarms"] if alarm["insertion_id"] == "slow"]
        sounded_s.append(alarm["at_s"])
    assert abs(sounded_s[1] - sounded_s[0]) < 0.9, "when it became one, not when somebody looked"
    again.gives_up()
    httpx.post(live.url(f"/v1/alarms/{alarm['number']}/acknowledge")).raise_for_status()


def test_a_restart_long_after_nothing_went_on_sounds_once(live: LiveService, monkeypatch: pytest.MonkeyPatch) -> None:
    put_back(live, "left")
    monkeypatch.setattr("service.web.page.status.AFRESH_S", 0.0)
    restarted = Status(live.station)
    assert headline(restarted) == HOLDING
    (alarm,) = [alarm for alarm in restarted.snapshot()["alarms"] if alarm["insertion_id"] == "left"]
    assert restarted.acknowledge(alarm["number"])
    assert headline(Status(live.station)) == {"level": "good", "words": "Ready for the next object"}


def ended(root: Path, second: int, **facts: Any) -> None:
    folder = root / f"20260101T0000{second:02d}_{facts['insertion_id']}"
    folder.mkdir()
    (folder / "summary.json").write_text(json.dumps({"outcome": "regrasped", "cause": "afresh", **facts}))


def test_an_attempt_that_went_down_counts_although_the_object_is_taken_afresh(tmp_path: Path) -> None:
    ended(tmp_path, 1, insertion_id="a", attempts=1, doubts=[DOUBT.model_dump()])
    ended(tmp_path, 2, insertion_id="b", attempts=2, continues="a")
    assert [one["descended_n"] for one in list_recordings(tmp_path)[0]] == [1, 1]
    put = newest(tmp_path)[1]
    assert put is not None
    assert (put.descended_n, put.goes_on("c").attempt, put.goes_on("c").afresh_n) == (2, 2, 2)


def test_an_attempt_that_was_refused_is_none_that_went_down(tmp_path: Path) -> None:
    """A client of one's own may also give up before its first attempt."""
    for second, (cause, attempts_n) in enumerate((("refused", 3), ("refused", 1), ("afresh", 0), ("arm", 1))):
        ended(tmp_path, second, insertion_id="one", attempts=attempts_n, cause=cause)
    assert [one["descended_n"] for one in list_recordings(tmp_path)[0]] == [1, 0, 0, 2]


def test_the_page_counts_a_doubted_attempt(live: LiveService) -> None:
    status, publish = Status(live.station), live.station.hub.publish
    opened = {"models": (), "cameras": (), "controller": "belief", "limits": live.station.settings.limits}
    publish("message", wire.ServiceHello(insertion_id="a", **opened))
    publish(
        "message", wire.Finished(insertion_id="a", outcome="regrasped", attempts=1, cause="afresh", doubts=(DOUBT,))
    )
    publish("client", wire.ClientHello(insertion_id="b", client="test", continues="a"))
    publish("message", wire.ServiceHello(insertion_id="b", **opened))
    publish("message", wire.Finished(insertion_id="b", outcome="inserted", attempts=1))
    assert status.snapshot()["last"]["words"] == "Object inserted after 2 attempts, regrasped once"
    assert httpx.get(live.url("/v1/status")).json()["last"]["attempts"] == 2
