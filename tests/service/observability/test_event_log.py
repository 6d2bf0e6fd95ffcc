from typing import get_args

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


def test_the_log_says_why_an_insertion_was_given_up_or_not_claimed() -> None:
    hub = Hub()
    log_events(hub)
    doubts = [
        wire.Doubt(reason="push", detail="the gels still carry a push"),
        wire.Doubt(reason="width", detail="gone"),
    ]
    with structlog.testing.capture_logs() as lines:
        hub.publish("client", wire.Abort(insertion_id="logged", cause="limits", reason="limits: target: z 3.1 mm"))
        ended = wire.Finished(insertion_id="logged", outcome="not_confirmed", attempts=1, cause="not_confirmed")
        hub.publish("message", ended.model_copy(update={"doubts": tuple(doubts)}))
    assert (lines[0]["cause"], lines[0]["reason"]) == ("limits", "limits: target: z 3.1 mm")
    assert lines[1]["doubts"] == "the gels still carry a push; gone"


def test_the_log_warns_of_what_was_given_up_and_not_of_what_ended_as_it_was_meant_to() -> None:
    hub = Hub()
    log_events(hub)
    causes = get_args(wire.Cause)
    with structlog.testing.capture_logs() as lines:
        for cause in causes:
            hub.publish("client", wire.Abort(insertion_id="logged", cause=cause, reason=cause))
    assert [line["event"] for line in lines] == ["abort"] * len(causes)
    assert [line["cause"] for line in lines if line["log_level"] == "info"] == ["operator", "probed", "afresh"]
