import structlog

from service.contract import wire
from service.observability.event_log import log_events
from service.observability.hub import Hub


def test_every_log_line_of_an_insertion_carries_its_id() -> None:
    hub = Hub()
    log_events(hub)
    messages = [
        wire.Armed(insertion_id="logged", attempt=1, reference_seq=3, frame_captured_ns=1),
        wire.NoDecision(insertion_id="logged", attempt=1, reason="no_motion", detail="nothing moved"),
        wire.Fault(insertion_id="logged", code="camera_lost", detail="left gone", fatal=False),
        wire.Finished(insertion_id="logged", outcome="aborted", attempts=1),
    ]
    with structlog.testing.capture_logs() as lines:
        for message in messages:
            hub.publish("message", message)
        hub.publish("camera_fault", {"finger": "left", "code": "camera_lost", "detail": "unplugged"})
        hub.publish("error", "disk full")
        hub.publish("frame", object())
    assert [line["insertion"] for line in lines[:4]] == ["logged"] * 4
    assert [line["log_level"] for line in lines] == ["info", "warning", "warning", "info", "warning", "error"]
    assert lines[1]["reason"] == "no_motion"
    assert (lines[4]["event"], lines[5]["detail"]) == ("camera", "disk full")
