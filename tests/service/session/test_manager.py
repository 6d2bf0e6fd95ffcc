"""Opening and handing over insertions: every request is answered, and a client that loses an insertion is informed."""

import json
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pydantic import SecretStr

from service.cameras.capture import CameraFrame
from service.contract import FINGERS, Finger, TactileFrame, wire
from service.decision.models import ModelSet, load_models
from service.observability.hub import Hub
from service.recordings.reader import Recording
from service.session.manager import InsertionManager
from service.settings import Settings
from tests.service import drawn


@pytest.fixture(scope="module")
def models(models_folder: Path) -> ModelSet:
    return load_models(models_folder)


def camera(finger: Finger, size: tuple[int, int]) -> SimpleNamespace:
    """A camera that has delivered one frame of ``size`` (width, height)."""
    pixels = np.zeros((size[1], size[0], 3), np.uint8)
    entry = wire.CameraEntry(finger=finger, source="x", state="live", frame_rate_hz=30.0)
    return SimpleNamespace(latest=CameraFrame(TactileFrame(finger, 0, 1, pixels), None), entry=entry)


def manager(models: ModelSet, folder: Path, size: tuple[int, int] = (427, 320)) -> InsertionManager:
    calibration = folder / "calibration.toml"
    drawn.calibration().save(calibration)
    settings = Settings(
        models=folder, camera_left="push:", camera_right="push:", recordings=folder / "r", calibration=calibration
    )
    cameras = {finger: camera(finger, size) for finger in FINGERS}
    return InsertionManager(settings, models, drawn.calibration(), cameras, Hub(), lambda _: None)


class Client:
    """The driving end of a connection."""

    def __init__(self, manager: InsertionManager) -> None:
        self.manager = manager
        self.heard: list[wire.ServiceMessage] = []

    def send(self, message: wire.ServiceMessage) -> None:
        self.heard.append(message)

    def connect(self, insertion_id: str = "one") -> wire.ServiceMessage:
        self.manager.connect(wire.ClientHello(insertion_id=insertion_id, client="test"), self.send)
        return self.heard[-1]


def wait_for_recorders() -> None:
    for thread in threading.enumerate():
        if thread.name in {"recorder", "close-recording"}:
            thread.join(20)
            assert not thread.is_alive()


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
    text: str | None, models: ModelSet, tmp_path: Path
) -> None:
    opened = manager(models, tmp_path)
    path = tmp_path / "calibration.toml"
    began_with = path.read_text()
    path.unlink()
    if text:
        path.write_text(text)
    client = Client(opened)
    assert client.connect().type == "hello"
    opened.abort("operator", "done")
    wait_for_recorders()
    (recorded,) = tmp_path.glob("r/*/insertion.mcap")
    assert Recording(recorded).metadata["calibration"] == began_with


def test_a_client_that_loses_its_insertion_to_another_connection_is_told_at_once(
    models: ModelSet, tmp_path: Path
) -> None:
    shared = manager(models, tmp_path)
    first, second = Client(shared), Client(shared)
    assert first.connect().type == second.connect().type == "hello"
    lost = first.heard[-1]
    assert (lost.type, lost.code, lost.fatal) == ("fault", "taken_over", True)
    assert [message.type for message in second.heard] == ["hello"]
    second.connect()
    assert [message.type for message in second.heard] == ["hello", "hello"], "who says hello again loses nothing"
    shared.abort("operator", "done")
    wait_for_recorders()


def test_asking_for_the_end_of_an_insertion_ends_no_other_one(models: ModelSet, tmp_path: Path) -> None:
    shared = manager(models, tmp_path)
    Client(shared).connect("first")
    shared.abort("operator", "done")
    driver = Client(shared)
    driver.connect("second")
    shared.disconnect(driver.send)
    assert Client(shared).connect("first").type == "finished"
    assert shared.active is not None
    assert shared.active.session.insertion_id == "second"
    shared.abort("operator", "done")
    wait_for_recorders()


def test_another_client_is_refused_while_one_drives_and_takes_over_once_it_is_gone(
    models: ModelSet, tmp_path: Path
) -> None:
    shared = manager(models, tmp_path)
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
    shared.abort("operator", "done")
    wait_for_recorders()


@pytest.mark.parametrize(("continues", "knows"), [("one", True), ("another", False), (None, False)])
def test_an_insertion_goes_on_with_what_the_one_before_knew_where_it_names_it(
    models: ModelSet, tmp_path: Path, continues: str | None, knows: bool
) -> None:
    shared = manager(models, tmp_path)
    client = Client(shared)
    client.connect("one")
    arm = wire.Arm(insertion_id="one", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0)
    shared.receive(arm, client.send)
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
    assert Recording(next(recorded.parent.glob("insertion.mcap"))).metadata["continues"] == ("one" if knows else "")
    assert shared.opened_n == 2


@pytest.mark.parametrize(("doubts", "tried_n"), [((), 1), ((wire.Doubt(reason="moved_in_hand", detail="turned"),), 2)])
def test_an_attempt_that_was_refused_for_a_regrasp_does_not_count_and_one_that_went_down_does(
    models: ModelSet, tmp_path: Path, doubts: tuple[wire.Doubt, ...], tried_n: int
) -> None:
    shared = manager(models, tmp_path)
    Client(shared).connect("one")
    shared.active.session.decider = decider = object()
    ended = wire.Finished(insertion_id="one", outcome="failed", cause="afresh", attempts=2, doubts=doubts)
    shared._close(ended)
    assert (shared._tried_n, shared._decided) == (tried_n, decider)
    wait_for_recorders()


def test_other_networks_go_on_with_nothing_that_the_ones_before_have_found(models: ModelSet, tmp_path: Path) -> None:
    shared = manager(models, tmp_path)
    client = Client(shared)
    client.connect("one")
    shared.receive(wire.Arm(insertion_id="one", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0), client.send)
    shared.abort("afresh", "turned")
    shared.models = replace(models)
    shared.connect(wire.ClientHello(insertion_id="two", client="test", continues="one"), Client(shared).send)
    assert shared.active.session.models is shared.models
    assert shared.active.session.decider is None
    shared.abort("operator", "done")
    wait_for_recorders()


def test_only_the_connection_that_drives_is_listened_to(models: ModelSet, tmp_path: Path) -> None:
    shared = manager(models, tmp_path)
    driver, other = Client(shared), Client(shared)
    driver.connect("one")
    arm = wire.Arm(insertion_id="one", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0)
    beat = wire.ClientHeartbeat(insertion_id="one", count=7)
    end = wire.Abort(insertion_id="one", cause="operator", reason="done")
    for message in (arm, beat, end):
        shared.receive(message, other.send)
    shared.disconnect(driver.send)
    shared.receive(arm, driver.send)
    assert shared.active.session.attempt is None
    assert ([message.type for message in driver.heard], other.heard) == (["hello"], [])
    driver.connect("one")
    shared.receive(arm, driver.send)
    assert shared.active.session.attempt is not None
    shared.receive(end, driver.send)
    wait_for_recorders()
    shared.receive(end, other.send)
    assert other.heard == []
    shared.receive(beat, other.send)
    assert [(message.type, message.count) for message in other.heard] == [("heartbeat", 7)], "who waits for the end"
    shared.receive(beat.model_copy(update={"insertion_id": "never"}), other.send)
    assert len(other.heard) == 1


def test_without_an_insertion_nothing_is_judged_and_nothing_fails(models: ModelSet, tmp_path: Path) -> None:
    idle = manager(models, tmp_path)
    idle.result(SimpleNamespace(generation=1))
    idle.fault("camera_lost", "left is gone")
    idle.tick(10**15)
    idle.abort("operator", "done")
    idle.disconnect(Client(idle).send)
    assert (idle.active, idle.opened_n) == (None, 0)


def test_an_insertion_ends_once_its_client_has_been_silent_for_too_long(models: ModelSet, tmp_path: Path) -> None:
    shared = manager(models, tmp_path)
    client = Client(shared)
    client.connect("one")
    heard_ns, allowed_ns = shared.active.received_ns, round(shared.settings.client_timeout_s * 1e9)
    shared.tick(heard_ns + allowed_ns)
    assert shared.active is not None
    shared.tick(heard_ns + allowed_ns + 1_000_000)
    assert shared.active is None
    wait_for_recorders()
    assert (client.heard[-1].outcome, client.heard[-1].cause) == ("failed", "link")


def test_no_token_is_kept_in_a_recording(models: ModelSet, tmp_path: Path) -> None:
    shared = manager(models, tmp_path)
    shared.settings = shared.settings.model_copy(update={"token_drive": SecretStr("swordfish")})
    Client(shared).connect("one")
    attached = shared._attachments(shared.active.session)
    shared.abort("operator", "done")
    wait_for_recorders()
    assert "configuration.json" in attached
    assert not {"token_watch", "token_drive", "token_admin"} & set(json.loads(attached["configuration.json"]))
    (recorded,) = tmp_path.glob("r/*/insertion.mcap")
    assert b"swordfish" not in recorded.read_bytes()


def test_what_an_insertion_shows_of_the_cell_goes_into_its_charts_unless_a_person_ended_it(
    models: ModelSet, tmp_path: Path
) -> None:
    cell = manager(models, tmp_path)
    ended = {"insertion_id": "one", "object": "box", "attempts": 2, "brightness_grey": 130.0}
    (tmp_path / "r").mkdir(exist_ok=True)
    cell._chart({**ended, "outcome": "aborted"}, models)
    assert not (tmp_path / "r" / "charts.json").exists()
    cell._chart({**ended, "outcome": "inserted"}, models)
    charts = json.loads((tmp_path / "r" / "charts.json").read_text())["charts"]
    assert charts["light"]["learnt"] == {"box": [130.0]}
    assert charts["trials"]["learnt"] == {"box": [2.0]}


@pytest.mark.parametrize("opened", [False, True])
def test_an_object_that_stays_in_the_hand_hangs_as_the_last_insertion_left_it(
    models: ModelSet, tmp_path: Path, *, opened: bool
) -> None:
    """A new insertion does not make it upright; only a hand that was open has grasped it anew."""
    given = manager(models, tmp_path)
    client = Client(given)
    client.connect("pressed")
    given.receive(wire.Arm(insertion_id="pressed", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0), client.send)
    assert given.active is not None
    assert given.active.session.attempt is not None
    given.active.session.attempt.descending_ns = 1
    given.abort("operator", "a person stops it")
    client.connect("again")
    session = given.active.session
    if opened:
        session.open_gels.ask(wire.LearnOpen(insertion_id="again"), (), 0)
        session.open_gels._learnt.update(FINGERS)
    given.receive(wire.Arm(insertion_id="again", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0), client.send)
    assert session.attempt is not None
    assert bool(session.attempt.tilt.unknown) != opened
    given.abort("operator", "a person stops it")
    assert bool(given.held_over) != opened, "an insertion that did not go down passes it on"
    wait_for_recorders()
    kept = [Recording(path).metadata["held_over"] for path in sorted((tmp_path / "r").glob("*/insertion.mcap"))]
    assert [bool(one) for one in kept] == [False, True], "deciding it again needs it"
