"""The description of the WebSockets matches the code: nothing missing, nothing left over, examples valid."""

import json
from typing import Any

import httpx
import jsonschema_rs
import pytest
from fastapi import APIRouter

from service import __version__
from service.contract import wire
from service.web import asyncapi
from service.web.app import create_app, warm
from tests.service.conftest import LiveService

DOCUMENT = json.loads(json.dumps(asyncapi.document(__version__)))
MESSAGES = {m.__name__: m for m in (*asyncapi.CLIENT, *asyncapi.SERVICE)}


def refs(part: Any) -> set[str]:
    if isinstance(part, dict):
        return {v for k, v in part.items() if k == "$ref"}.union(*(refs(v) for v in part.values()))
    return set().union(*(refs(v) for v in part)) if isinstance(part, list) else set()


def find(ref: str) -> Any:
    place: Any = DOCUMENT
    for key in ref.removeprefix("#/").split("/"):
        place = place[key]
    return place


def test_every_reference_leads_somewhere() -> None:
    assert len(refs(DOCUMENT)) > 20
    for ref in refs(DOCUMENT):
        find(ref)


@pytest.mark.parametrize(
    ("operation", "union", "action"),
    [("hearClient", wire.ClientMessage, "receive"), ("tellClient", wire.ServiceMessage, "send")],
)
def test_every_message_of_the_code_is_described_in_its_direction(operation: str, union: Any, action: str) -> None:
    entry = DOCUMENT["operations"][operation]
    described = {find(find(m["$ref"])["$ref"])["title"] for m in entry["messages"]}
    assert described == {model.__name__ for model in asyncapi.messages_of(union)}
    assert entry["action"] == action


@pytest.mark.parametrize("name", sorted(MESSAGES))
def test_examples_are_valid_and_the_code_reads_them(name: str) -> None:
    message = DOCUMENT["components"]["messages"][name]
    schema = {"$ref": message["payload"]["$ref"], "components": DOCUMENT["components"]}
    assert message["examples"]
    for example in message["examples"]:
        jsonschema_rs.validator_for(schema).validate(example["payload"])
        parse = wire.parse_client if MESSAGES[name] in asyncapi.CLIENT else wire.parse_service
        read = parse(json.dumps(example["payload"]))
        assert type(read) is MESSAGES[name]
        assert read.type == message["name"]


def test_a_key_that_the_code_refuses_is_refused_by_the_schema() -> None:
    schema = {"$ref": "#/components/schemas/Arm", "components": DOCUMENT["components"]}
    arm = {"type": "arm", "insertion_id": "x", "attempt": 1, "gap_width_mm": 56.0, "expected_depth_mm": 25.0}
    validator = jsonschema_rs.validator_for(schema)
    assert validator.is_valid(arm)
    for wrong in ({"attempt": 16}, {"gap_width_mm": 0}, {"insertion_id": "a b"}, {"speed": 3}):
        assert not validator.is_valid(arm | wrong)
        with pytest.raises(ValueError, match=next(iter(wrong))):
            wire.parse_client(json.dumps(arm | wrong))


@pytest.mark.parametrize("name", sorted(MESSAGES))
def test_a_message_without_its_type_is_refused_by_its_schema_as_by_the_code(name: str) -> None:
    (example, *_) = DOCUMENT["components"]["messages"][name]["examples"]
    untyped = {key: value for key, value in example["payload"].items() if key != "type"}
    schema = {"$ref": f"#/components/schemas/{name}", "components": DOCUMENT["components"]}
    assert not jsonschema_rs.validator_for(schema).is_valid(untyped)
    parse = wire.parse_client if MESSAGES[name] in asyncapi.CLIENT else wire.parse_service
    with pytest.raises(ValueError, match="type"):
        parse(json.dumps(untyped))


def test_every_websocket_has_its_channel(live: LiveService, monkeypatch: pytest.MonkeyPatch) -> None:
    paths: set[str] = set()
    monkeypatch.setattr(
        APIRouter, "add_api_websocket_route", lambda router, path, *_, **__: paths.add(router.prefix + path)
    )
    create_app(live.station)
    same = {"/"}  # as /v1/insertion, for clients that name no path
    assert {channel["address"] for channel in DOCUMENT["channels"].values()} == paths - same


def test_the_service_serves_it_and_asks_for_the_same_token_as_over_http(live: LiveService) -> None:
    assert httpx.get(live.url("/v1/asyncapi.json")).json() == DOCUMENT
    schemes = httpx.get(live.url("/openapi.json")).json()["components"]["securitySchemes"]
    assert DOCUMENT["servers"]["cell"]["security"] == [schemes["token"]]


def test_no_request_waits_for_a_description_to_be_made(live: LiveService, monkeypatch: pytest.MonkeyPatch) -> None:
    app = create_app(live.station)
    asyncapi.document.cache_clear()
    warm(app)
    monkeypatch.setattr("fastapi.applications.get_openapi", None)
    monkeypatch.setattr(asyncapi, "models_json_schema", None)
    assert app.openapi()["paths"]
    assert asyncapi.document(__version__) == DOCUMENT
