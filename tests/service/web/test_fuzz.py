"""Any input: no 5xx, no dead session. Afterwards a correct client still completes its insertion."""

import contextlib
import itertools
import json
import time

import httpx
import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
    status_code_conformance,
)
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from service.contract import wire
from service.web import asyncapi
from tests.service.client import Driver, greeted
from tests.service.conftest import LiveService

CHECKS = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
]
SOCKETS = ["/v1/insertion", "/", "/v1/cameras/left/push", "/v1/cameras/left/frames", "/v1/live"]
numbers = itertools.count()


def ask_everything(live: LiveService, examples_n: int) -> int:
    """Requests made from the OpenAPI description for each of its operations; returns how many operations there are."""
    schema = schemathesis.openapi.from_url(live.url("/openapi.json"))
    schema = schema.exclude(path_regex=r"stream\.mjpg$")  # it never ends; the camera tests read it
    schema = schema.exclude(path="/readyz")  # 503 is its way to say that a camera is not live
    operations = [result.ok() for result in schema.get_all_operations()]
    for operation in operations:

        @settings(max_examples=examples_n, deadline=None, suppress_health_check=list(HealthCheck), database=None)
        @given(case=operation.as_strategy())
        def ask(case: schemathesis.Case) -> None:
            case.call_and_validate(checks=CHECKS, headers=live.bearer)

        ask()
    return len(operations)


def test_no_request_makes_the_service_fail_and_every_answer_is_as_described(live: LiveService) -> None:
    assert ask_everything(live, 1) >= 25


@pytest.mark.slow
def test_many_requests_do_not_make_the_service_fail(live: LiveService) -> None:
    ask_everything(live, 30)
    is_well(live)


junk = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=10),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=6,
)
VALID = [e.model_dump(mode="json") for e in asyncapi.EXAMPLES]
mutated = st.builds(
    lambda message, key, value, drop: {k: v for k, v in (message | {key: value}).items() if k != drop},
    st.sampled_from(VALID),
    st.sampled_from(sorted({key for message in VALID for key in message})),
    junk | st.sampled_from([1e308, -1, 0, 2**63, "left", "\ud800", "insertion-1"]),
    st.none() | st.sampled_from(["type", "attempt", "insertion_id"]),
)
ordered = st.sampled_from(VALID)  # valid by itself, but in any order
text = st.one_of(st.text(max_size=200), junk.map(json.dumps), mutated.map(json.dumps), ordered.map(json.dumps))
frames = st.lists(text | st.binary(max_size=200) | st.just(b"TIF1" + bytes(24)), max_size=8)


def talk(live: LiveService, path: str, sent: list[str | bytes], hello: bool) -> None:
    """Say all this and listen a little; being refused or closed is a fine answer."""
    with (
        contextlib.suppress(ConnectionClosed, InvalidStatus),
        connect(live.url(path, "ws"), additional_headers=live.bearer, compression=None) as link,
    ):
        if hello:
            link.send(wire.ClientHello(insertion_id="insertion-1", client="fuzz").model_dump_json())
        for one in sent:
            link.send(one.encode("utf-8", "surrogatepass").decode("utf-8", "replace") if isinstance(one, str) else one)
        with contextlib.suppress(TimeoutError):
            for _ in range(len(sent) + 1):
                link.recv(0.02)


def first_to_drive(live: LiveService) -> Driver:
    """A client that drives once the service has noticed the end of the fuzzing ones."""
    deadline = time.monotonic() + 50
    while True:
        driver = Driver(live, f"after-fuzz-{next(numbers)}")
        answer = driver.receive()
        if answer.type == "hello":
            return driver
        assert answer.code == "busy"
        assert time.monotonic() < deadline, "a connection that is closed still drives"
        driver.close()
        time.sleep(0.05)


def is_well(live: LiveService) -> None:
    """Alive, ready, no exception inside, and a correct client gets through."""
    assert httpx.get(live.url("/healthz")).status_code == 200
    assert live.station.counters.perception_errors_n == live.station.hub.errors_n == 0
    driver = first_to_drive(live)
    driver.attempt(1)
    assert driver.insert(2).outcome == "inserted"
    driver.close()


@pytest.mark.slow
def test_a_thousand_conversations_do_not_kill_a_session(live: LiveService) -> None:
    @settings(max_examples=1000, deadline=None, suppress_health_check=list(HealthCheck), database=None)
    @given(path=st.sampled_from(SOCKETS), sent=frames, hello=st.booleans())
    def fuzz(path: str, sent: list[str | bytes], hello: bool) -> None:
        talk(live, path, sent, hello)

    fuzz()
    is_well(live)


def test_an_oversized_message_closes_the_connection_and_nothing_else(live: LiveService) -> None:
    driver = greeted(live, f"beside-{next(numbers)}")
    for size in (wire.MAX_TEXT_BYTES + 1, 5 << 20):
        with connect(live.url("/v1/insertion", "ws"), additional_headers=live.bearer, compression=None) as link:
            with contextlib.suppress(ConnectionClosed):
                link.send("x" * size)
            heard = []
            with contextlib.suppress(ConnectionClosed):
                while True:
                    heard.append(wire.parse_service(link.recv(10)))
            assert [(fault.code, fault.fatal) for fault in heard] in ([], [("bad_message", True)]), "or overtaken"
    driver.attempt(1)
    assert driver.insert(2).outcome == "inserted"
    driver.close()
