"""docs/api.md names every message, every number and every value of every enumeration that goes over the wire."""

import re
from collections.abc import Iterator
from typing import Any

import pytest

from service.web.asyncapi import CLIENT, SERVICE, document
from tests.docs.commands import ROOT

PAGE = (ROOT / "docs" / "api.md").read_text()
QUOTED = set(re.findall(r"`([^`\n]+)`", PAGE))
WILD = tuple(word[:-1] for word in QUOTED if word.endswith("_*"))
SCHEMAS = document("0")["components"]["schemas"]
OF_THE_CARD = {"ModelCard", "ModelEntry", "FrameSpec", "ErrorClass", "InputSpec"}  # docs/model_card.md


def parts(schema: Any) -> Iterator[dict[str, Any]]:
    """A schema and everything inside it."""
    if isinstance(schema, dict):
        yield schema
        for inner in schema.values():
            yield from parts(inner)
    elif isinstance(schema, list):
        for inner in schema:
            yield from parts(inner)


def reachable(names: set[str]) -> set[str]:
    """The schemas that messages are made of, without those of a model's card."""
    reached: set[str] = set()
    while names - reached:
        reached |= names
        inner = [part["$ref"].rsplit("/", 1)[1] for name in names for part in parts(SCHEMAS[name]) if "$ref" in part]
        names = set(inner) - OF_THE_CARD
    return reached


WIRE = reachable({model.__name__ for model in (*CLIENT, *SERVICE)})
ENUMERATED = {
    (name, field, value)
    for name in WIRE
    for field, schema in SCHEMAS[name]["properties"].items()
    for part in parts(schema)
    for value in part.get("enum", ())
}
NUMBERS = {
    (name, field)
    for name in WIRE
    for field, schema in SCHEMAS[name]["properties"].items()
    if field not in {"protocol", "attempt"} and any(p.get("type") in {"number", "integer"} for p in parts(schema))
}


@pytest.mark.parametrize(("message", "field", "value"), sorted(ENUMERATED))
def test_every_value_of_every_enumeration_is_explained(message, field, value):
    assert value in QUOTED
    assert field in QUOTED or f"`{field}` of" in PAGE or field in PAGE


@pytest.mark.parametrize(("message", "field"), sorted(NUMBERS))
def test_every_number_has_its_zero_and_sign(message, field):
    assert field in QUOTED or field.startswith(WILD)


def test_every_message_is_named():
    assert {model.model_fields["type"].default for model in (*CLIENT, *SERVICE)} <= QUOTED


def test_the_page_invents_no_fault_and_no_reason():
    """Words in the tables of enumerations that no enumeration has would teach clients what never comes."""
    table = PAGE.split("### All values of every enumeration")[1].split("Every close has")[0]
    rows = [line.split("|")[2] for line in table.splitlines() if line.startswith("| ") and "---" not in line]
    taught = {word for row in rows[1:] for word in re.findall(r"`([a-z_]+)`", row)}
    assert taught == {value for _, _, value in ENUMERATED}
