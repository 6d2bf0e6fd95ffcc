"""Opening and handing over insertions: every request is answered, and a client that loses an insertion is informed."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from pydantic import SecretStr

from service.contract import FINGERS, wire
from service.decision.attempt import Stage
from service.decision.models import ModelSet
from service.recordings.reader import Recording
from service.session.learn_open import STARTED
from service.session.manager import InsertionManager
from tests.service.recordings.test_described import attachments
from tests.service.session.driving import Client, arm, manager, wait_for_recorders


@pytest.fixture
def shared(models: ModelSet, tmp_path: Path) -> Iterator[InsertionManager]:
    made = manager(models, tmp_path)
    yield made
    made.abort("operator", "test over")
    wait_for_recorders()


def test_a_client_is_told_that_a_camera_has_another_size_now(models: ModelSet, tmp_path: Path) -> None:
    tried = manager(models, tmp_path, size=(640, 480))
    for _ in range(2):
        fault = Client(tried).connect()
        assert (fault.type, fault.code, fault.fatal) == ("fault", "not_ready", True)
        assert "frame is uint8[480, 640, 3], expected uint8[320, 427, 3]" in fault.detail
    assert tried.active is None
    wait_for_recorders()
    assert list(tmp_path.glob("r/*/*.part")) == []


@pytest.mark.parametrize("text", [None, "schema_version = 2"])
def test_a_recording_keeps_the_calibration_that_the_service_began_with(
    text: str | None, shared: InsertionManager, tmp_path: Path
) -> None:
    path = tmp_path / "calibration.toml"
    began_with = path.read_text()
    path.unlink()
    if text:
        path.write_text(text)
    client = Client(shared)
    assert client.connect().type == "hello"
    shared.abort("operator", "done")
    wait_for_recorders()
    (recorded,) = tmp_path.glob("r/*/insertion.mcap")
    assert Recording(recorded).metadata["calibration"] == began_with
    assert attachments(recorded)["calibration.toml"].decode() == began_with


def test_a_client_that_loses_its_insertion_to_another_connection_is_told_at_once(shared: InsertionManager) -> None:
    first, second = Client(shared), Client(shared)
    assert first.connect().type == second.connect().type == "hello"
    lost = first.heard[-1]
    assert (lost.type, lost.code, lost.fatal) == ("fault", "taken_over", True)
    assert [message.type for message in second.heard] == ["hello"]
    second.connect()
    assert [message.type for message in second.heard] == ["hello", "hello"], "who says hello again loses nothing"


def test_asking_for_the_end_of_an_insertion_ends_no_other_one(shared: InsertionManager) -> None:
    Client(shared).connect("first")
    shared.abort("operator", "done")
    driver = Client(shared)
    driver.connect("second")
    shared.disconnect(driver.send)
    assert Client(shared).connect("first").type == "finished"
    assert shared.active is not None
    assert shared.active.session.insertion_id == "second"


def test_another_client_is_refused_while_one_drives_and_takes_over_once_it_is_gone(shared: InsertionManager) -> None:
    first, second = Client(shared), Client(shared)
    first.connect("first")
    refused = second.connect("second")
    assert (refused.type, refused.code, refused.fatal) == ("fault", "busy", True)
    assert [message.type for message in first.heard] == ["hello"], "who drives notices nothing"
    shared.disconnect(second.send)
    assert shared.active.send is not None, "a watcher that leaves takes no insertion with it"
    shared.disconnect(first.send)
    assert second.connect("second").type == "hello"
    assert shared.active.session.insertion_id == "second"


@pytest.mark.parametrize(("continues", "knows"), [("one", True), ("another", False), (None, False)])
def test_an_insertion_goes_on_with_what_the_one_before_knew_where_it_names_it(
    shared: InsertionManager, tmp_path: Path, continues: str | None, knows: bool
) -> None:
    client = Client(shared)
    client.connect("one")
    shared.receive(arm(), client.send)
    decider = shared.active.session.decider
    shared.jpegs["left", 3] = b"a picture"
    shared.abort("part_lost", "turned")
    wait_for_recorders()
    shared.connect(wire.ClientHello(insertion_id="two", client="test", continues=continues), Client(shared).send)
    session = shared.active.session
    assert shared.active.tried_n == knows
    assert not shared.jpegs, "nothing is kept from insertion to insertion"
    assert (session.decider is not None) == knows
    if knows:
        assert session.decider.controller is decider.controller
        assert session.decider.insertion_id == "two"
    (recorded,) = [path for path in tmp_path.glob("r/*/insertion.mcap*") if "two" in str(path)]
    shared.abort("operator", "done")
    wait_for_recorders()
    assert Recording(recorded.with_name("insertion.mcap")).metadata["continues"] == ("one" if knows else "")
    assert json.loads(recorded.with_name("summary.json").read_text()).get("earlier_n") == (1 if knows else None)
    assert shared.opened_n == 2


@pytest.mark.parametrize(("doubts", "tried_n"), [((), 1), ((wire.Doubt(reason="moved_in_hand", detail="turned"),), 2)])
def test_an_attempt_that_was_refused_for_a_regrasp_does_not_count_and_one_that_went_down_does(
    shared: InsertionManager, doubts: tuple[wire.Doubt, ...], tried_n: int
) -> None:
    client = Client(shared)
    client.connect("one")
    shared.receive(arm(), client.send)
    ended = wire.Finished(insertion_id="one", outcome="regrasped", cause="afresh", attempts=2, doubts=doubts)
    shared.active.publish("finished", ended)
    shared.connect(wire.ClientHello(insertion_id="two", client="test", continues="one"), client.send)
    assert shared.active.tried_n == tried_n


def test_other_networks_go_on_with_nothing_that_the_ones_before_have_found(
    shared: InsertionManager, models: ModelSet
) -> None:
    client = Client(shared)
    client.connect("one")
    shared.receive(arm(), client.send)
    shared.abort("afresh", "turned")
    shared.models = replace(models)
    shared.connect(wire.ClientHello(insertion_id="two", client="test", continues="one"), Client(shared).send)
    assert shared.active.session.models is shared.models
    assert shared.active.session.decider is None


def test_a_regrasped_object_goes_on_with_its_controller_and_hello_names_it(shared: InsertionManager) -> None:
    client = Client(shared)
    shared.connect(wire.ClientHello(insertion_id="one", client="test", controller="heuristic"), client.send)
    shared.receive(arm(), client.send)
    shared.abort("afresh", "turned")
    shared.connect(wire.ClientHello(insertion_id="two", client="test", continues="one"), client.send)
    assert shared.active.session.decider.controller.name == "heuristic"
    (_, hello) = (one for one in client.heard if isinstance(one, wire.ServiceHello))  # `finished` may come after it
    assert hello.controller == "heuristic"


@pytest.mark.parametrize(("continues", "keeps"), [("one", True), ("another", False)])
def test_only_an_insertion_that_goes_on_keeps_the_version_before_a_change(
    shared: InsertionManager, models: ModelSet, continues: str, *, keeps: bool
) -> None:
    shared.versions = SimpleNamespace(active=models, beside=lambda *_: None)
    client = Client(shared)
    client.connect("one")
    shared.receive(arm(), client.send)
    shared.abort("refused", "turned in the hand")
    shared.versions.active = replace(models)
    shared.connect(wire.ClientHello(insertion_id="two", client="test", continues=continues), client.send)
    assert (shared.active.session.models is models) == keeps
    assert (shared.active.session.models is shared.versions.active) != keeps


def test_a_heartbeat_tells_the_age_of_the_cameras_frames_whether_or_not_an_attempt_needs_them(
    shared: InsertionManager, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The camera that is further behind, before the first `arm` and after an attempt that frames were judged in."""
    driver = Client(shared)
    driver.connect("one")
    for attempt, newest_s, age_ms in ((None, 5, 500.0), (1, 8, 2000.0)):
        if attempt:
            shared.receive(arm(), driver.send)
            shared.active.session.attempt.stage = Stage.DECIDED
        for finger, behind_s in (("left", 0), ("right", 1)):
            shared.cameras[finger].newest_ns = (newest_s - behind_s) * 10**9
        at_ns = (newest_s - 1) * 10**9 + round(age_ms * 1e6)
        monkeypatch.setattr("service.session.insertion.now_ns", lambda at_ns=at_ns: at_ns)
        shared.receive(wire.ClientHeartbeat(insertion_id="one", count=7), driver.send)
        assert driver.heard[-1].frame_age_ms == age_ms


def test_only_the_connection_that_drives_is_listened_to(shared: InsertionManager) -> None:
    driver, other = Client(shared), Client(shared)
    driver.connect("one")
    arms = arm()
    beat = wire.ClientHeartbeat(insertion_id="one", count=7)
    end = wire.Abort(insertion_id="one", cause="operator", reason="done")
    for message in (arms, beat, end):
        shared.receive(message, other.send)
    shared.disconnect(driver.send)
    shared.receive(arms, driver.send)
    assert shared.active.session.attempt is None
    assert ([message.type for message in driver.heard], other.heard) == (["hello"], [])
    driver.connect("one")
    shared.receive(arms, driver.send)
    assert shared.active.session.attempt is not None
    shared.receive(end, driver.send)
    wait_for_recorders()
    shared.receive(end, other.send)
    assert other.heard == []
    shared.receive(beat, other.send)
    assert [(message.type, message.count) for message in other.heard] == [("heartbeat", 7)], "who waits for the end"
    shared.receive(beat.model_copy(update={"insertion_id": "never"}), other.send)
    assert len(other.heard) == 1


def test_without_an_insertion_nothing_is_judged_and_nothing_fails(shared: InsertionManager) -> None:
    shared.result(SimpleNamespace(generation=1))
    shared.fault("camera_lost", "left is gone")
    shared.tick(10**15)
    shared.abort("operator", "done")
    shared.disconnect(Client(shared).send)
    assert (shared.active, shared.opened_n) == (None, 0)


def test_an_insertion_ends_once_its_client_has_been_silent_for_too_long(shared: InsertionManager) -> None:
    client = Client(shared)
    client.connect("one")
    heard_ns, allowed_ns = shared.active.received_ns, round(shared.settings.client_timeout_s * 1e9)
    shared.tick(heard_ns + allowed_ns)
    assert shared.active is not None
    shared.tick(heard_ns + allowed_ns + 1_000_000)
    assert shared.active is None
    wait_for_recorders()
    assert (client.heard[-1].outcome, client.heard[-1].cause) == ("failed", "link")


def test_no_token_is_kept_in_a_recording(shared: InsertionManager, tmp_path: Path) -> None:
    shared.settings = shared.settings.model_copy(update={"token_drive": SecretStr("swordfish")})
    Client(shared).connect("one")
    shared.abort("operator", "done")
    wait_for_recorders()
    (recorded,) = tmp_path.glob("r/*/insertion.mcap")
    configuration = json.loads(attachments(recorded)["configuration.json"])
    assert not {"token_watch", "token_drive", "token_admin"} & set(configuration)
    assert b"swordfish" not in recorded.read_bytes()


def test_what_an_insertion_shows_of_the_cell_goes_into_its_charts_unless_it_was_meant_to_end_before_it_was_in(
    shared: InsertionManager, models: ModelSet, tmp_path: Path
) -> None:
    ended = {"insertion_id": "one", "object": "box", "attempts": 2, "brightness_grey": 130.0}
    (tmp_path / "r").mkdir(exist_ok=True)
    for outcome in ("aborted", "probed", "regrasped"):
        shared._chart({**ended, "outcome": outcome}, models)
    assert not (tmp_path / "r" / "charts.json").exists()
    shared._chart({**ended, "outcome": "inserted"}, models)
    charts = json.loads((tmp_path / "r" / "charts.json").read_text())["charts"]
    assert charts["light"]["learnt"] == {"box": [130.0]}
    assert charts["trials"]["learnt"] == {"box": [2.0]}
    for continued in ({"earlier_n": 3}, {}):  # of the second it is not known how many came before
        shared._chart({**ended, "outcome": "inserted", "continues": "zero", **continued}, models)
    charts = json.loads((tmp_path / "r" / "charts.json").read_text())["charts"]
    assert charts["trials"]["learnt"] == {"box": [2.0, 5.0]}


@pytest.mark.parametrize("opened", [False, True])
def test_an_object_that_stays_in_the_hand_hangs_as_the_last_insertion_left_it(
    shared: InsertionManager, tmp_path: Path, *, opened: bool
) -> None:
    """A new insertion does not make it upright; only a hand that was open has grasped it anew."""
    client = Client(shared)
    client.connect("pressed")
    shared.receive(arm("pressed"), client.send)
    assert shared.active is not None
    assert shared.active.session.attempt is not None
    shared.active.session.attempt.descending_ns = 1
    shared.abort("operator", "a person stops it")
    passed_on = shared.held_over
    client.connect("again")
    session = shared.active.session
    if opened:
        session.open_gels.ask(wire.LearnOpen(insertion_id="again"), (), 0)
        session.open_gels._learnt.update(FINGERS)
    shared.receive(arm("again"), client.send)
    assert session.attempt is not None
    assert bool(session.attempt.tilt.unknown) != opened
    shared.abort("operator", "a person stops it")
    assert bool(shared.held_over) != opened, "an insertion that did not go down passes it on"
    wait_for_recorders()
    kept = [Recording(path).metadata["held_over"] for path in sorted((tmp_path / "r").glob("*/insertion.mcap"))]
    assert kept == [STARTED, passed_on], "deciding it again needs it"
