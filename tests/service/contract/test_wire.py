import json

import pytest

from service.contract import ContractError, wire
from service.contract.replies import unspoken
from service.contract.wire import (
    PROTOCOL,
    Abort,
    Arm,
    ClientHello,
    Correction,
    Descending,
    Estimate,
    Fault,
    Stopped,
    parse_client,
    parse_service,
)

CORRECTION = Correction(
    insertion_id="a",
    attempt=1,
    dx_mm=-2.0,
    dtheta_deg=0.5,
    class_probabilities={"1": 0.25, "2": 0.75},
    estimate=Estimate(dx_mm=3.0, dtheta_deg=0.0),
    confidence=0.75,
    controller="heuristic",
    reason="S_x = 1",
    latency_ms={"network": 2.0},
)


@pytest.mark.parametrize(
    "message",
    [
        ClientHello(insertion_id="a", client="test"),
        Arm(insertion_id="a", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0),
        Descending(insertion_id="a", attempt=15),
        Stopped(insertion_id="a", attempt=2, depth_mm=6.5, outcome="blocked", still_s=0.15),
        Abort(insertion_id="a", cause="operator", reason="panel"),
    ],
)
def test_client_messages_survive_the_wire(message):
    assert parse_client(message.model_dump_json()) == message


@pytest.mark.parametrize("message", [CORRECTION, Fault(insertion_id="a", code="camera_lost", detail="left")])
def test_service_messages_survive_the_wire(message):
    assert parse_service(message.model_dump_json()) == message


@pytest.mark.parametrize("bad", ["NaN", "Infinity", "1e999", '"3"', "null", "true"])
def test_a_correction_that_is_no_finite_number_is_refused(bad):
    text = CORRECTION.model_dump_json().replace('"dx_mm":-2.0', f'"dx_mm":{bad}', 1)
    with pytest.raises(ContractError, match=r"dx_mm|JSON"):
        parse_service(text)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"attempt": 0}, "attempt"),
        ({"attempt": 16}, "attempt"),
        ({"gap_width_mm": -56.0}, "gap_width_mm"),
        ({"insertion_id": "../etc"}, "insertion_id"),
        ({"type": "jump"}, "jump"),
        ({"extra": 1}, "extra"),
    ],
)
def test_a_wrong_field_is_named(change, named):
    body = json.loads(Arm(insertion_id="a", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0).model_dump_json())
    with pytest.raises(ContractError, match=named):
        parse_client(json.dumps(body | change))


def test_a_hello_of_version_1_is_read_and_refused_with_a_sentence():
    """It lacks what version 2 added, and must still be understood as far as its version."""
    old = {"type": "hello", "insertion_id": "a", "protocol": 1, "client": "older"}
    refused = unspoken(parse_client(json.dumps(old)))
    assert refused is not None
    assert refused.fatal
    assert refused.detail == f"client speaks protocol 1, this service {PROTOCOL}; update the older one"


@pytest.mark.parametrize(("sent_ns", "at_ns"), [(1 << 62, 1 << 62), (10**12, 1 << 70), (10**12, -2 * 10**18), (-1, 0)])
def test_a_stamp_that_no_recording_could_hold_is_refused(sent_ns: int, at_ns: int) -> None:
    sample = wire.RobotSample(at_ns=at_ns, phase="descending", attempt=1)
    with pytest.raises(ValueError, match=r"sent_ns"):
        wire.Telemetry(insertion_id="one", sent_ns=sent_ns, samples=(sample,))
