"""A recording describes itself to the reference reader: one schema a topic, JSON as its schema says, what decided."""

import json
import tomllib
from pathlib import Path

import jsonschema_rs
import pytest
from mcap.reader import make_reader

from service.contract import ModelCard, wire
from service.recordings.reader import Entry, RecordingError
from service.recordings.recovery import recover
from service.recordings.writer import FINAL, PART, Recorder
from tests.service.client import greeted
from tests.service.conftest import LiveService

ATTACHED = ["calibration.toml", "configuration.json", "tiny-direction.card.json", "tiny-magnitude.card.json"]


@pytest.fixture(scope="module")
def recording(live: LiveService) -> Path:
    """An insertion with a correction, and a telling client."""
    driver = greeted(live, "described")
    pose = wire.ToolPose(x_mm=1.0, y_mm=0.0, z_mm=30.0, yaw_deg=2.0)
    driver.send(wire.Episode(insertion_id="described", object="box", start=pose, approach=pose))
    sample = wire.RobotSample(at_ns=1, phase="descending", attempt=1, measured=pose)
    driver.send(wire.Telemetry(insertion_id="described", sent_ns=2, samples=(sample,)))
    driver.attempt(1)
    path = driver.insert(2).recording
    driver.close()
    return Path(path)


def test_each_topic_has_one_channel_and_one_schema_whatever_it_holds(recording: Path) -> None:
    with recording.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    topics = [channel.topic for channel in summary.channels.values()]
    assert sorted(topics) == sorted(
        ["/calls", "/left/image", "/left/markers", "/messages", "/right/image", "/right/markers", "/robot"]
    )
    assert all(summary.schemas[channel.schema_id].data for channel in summary.channels.values())


def test_every_json_message_is_what_its_schema_says_and_the_schema_says_something(recording: Path) -> None:
    schemas = {}
    with recording.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            if schema.encoding == "jsonschema":
                described = schemas.setdefault(channel.topic, json.loads(schema.data))
                jsonschema_rs.validator_for(described).validate(json.loads(message.data))
    assert set(schemas) == {"/calls", "/messages", "/robot"}
    for described in schemas.values():
        assert described["properties"]
        with pytest.raises(jsonschema_rs.ValidationError):
            jsonschema_rs.validator_for(described).validate({"depth_mm": "deep"})


def attachments(path: Path) -> dict[str, bytes]:
    with path.open("rb") as stream:
        return {attached.name: attached.data for attached in make_reader(stream).iter_attachments()}


def test_cards_calibration_and_configuration_lie_inside_and_no_token_does(live: LiveService, recording: Path) -> None:
    attached = attachments(recording)
    assert sorted(attached) == ATTACHED
    cards = {entry.card.name: entry.card for entry in live.station.models.entries}
    for name, card in cards.items():
        assert ModelCard.model_validate_json(attached[f"{name}.card.json"]) == card
    assert tomllib.loads(attached["calibration.toml"].decode())
    assert json.loads(attached["configuration.json"])["camera_left"] == live.fingers[0].url
    assert live.token.encode() not in b"".join(attached.values())


def test_a_probe_that_a_crash_ended_is_still_a_probe_of_its_object(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, "crashed", {})
    hello = wire.ClientHello(insertion_id="crashed", client="test", continues="before")
    recorder.message("client", hello.model_dump(mode="json"), 0)
    pose = wire.ToolPose(x_mm=8.0, y_mm=0.0, z_mm=35.0, yaw_deg=6.0)
    episode = wire.Episode(
        insertion_id="crashed", purpose="probe", simulated=True, object="box", start=pose, approach=pose
    )
    recorder.message("client", episode.model_dump(mode="json"), 1)
    path = recorder.close({"outcome": "aborted"})
    (path.parent / "summary.json").unlink()
    path.rename(path.with_name(PART))
    recover(tmp_path)
    summary = json.loads((path.parent / "summary.json").read_text())
    assert (summary["purpose"], summary["object"], summary["outcome"]) == ("probe", "box", "interrupted")
    assert (summary["continues"], summary["simulated"]) == ("before", True)


def test_what_a_crash_left_keeps_its_attachments(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, "crashed", {}, attachments={"configuration.json": b"{}"})
    path = recorder.close({"outcome": "inserted"})
    part = path.rename(path.with_name(PART))
    assert recover(tmp_path) == [part.with_name(FINAL)]
    assert attachments(part.with_name(FINAL)) == {"configuration.json": b"{}"}


@pytest.mark.parametrize("data", [b"{", b"[1]", b"\xff", b"[" * 100_000])
def test_a_message_that_is_no_json_object_is_named(data: bytes) -> None:
    with pytest.raises(RecordingError, match="message 3 of /messages is no JSON object"):
        Entry("/messages", 0, 3, data).json()
