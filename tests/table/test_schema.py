"""The schema file itself: valid, strict, and a description for every key."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jsonschema
import pytest

from router.table.keys import keys_of
from router.table.model import (
    Collect,
    Deadman,
    Destination,
    Endpoint,
    Gateway,
    Inbound,
    InboundDeadman,
    Listener,
    NodeSettings,
    Qos,
    RecordSettings,
    Route,
    Topic,
    ZenohSettings,
)
from router.table.schema import table_schema


def keys(schema: object, path: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Every key that a table may have, with its own schema."""
    if isinstance(schema, list):
        for member in schema:
            yield from keys(member, path)
    if isinstance(schema, dict):
        for name, member in schema.get("properties", {}).items():
            yield f"{path}/{name}", member
        for name, member in schema.items():
            if name != "if" and not name.startswith("complete"):  # conditions describe nothing
                yield from keys(member, f"{path}/{name}")


def resolved(schema: dict[str, Any]) -> dict[str, Any]:
    reference = schema.get("$ref")
    return table_schema()["definitions"][reference.rpartition("/")[2]] if reference else schema


def test_it_is_a_valid_draft_07_schema() -> None:
    jsonschema.Draft7Validator.check_schema(table_schema())


def test_every_key_has_a_title_and_a_description() -> None:
    bare = [path for path, schema in keys(table_schema()) if not {"title", "description"} <= resolved(schema).keys()]
    assert bare == []


def test_mappings_with_known_keys_refuse_others() -> None:
    closed = [
        schema
        for name, schema in table_schema()["definitions"].items()
        if name != "choice" and isinstance(schema, dict) and schema.get("type") == "object" and "properties" in schema
    ]
    assert closed
    assert all(schema["additionalProperties"] is False for schema in [table_schema(), *closed])


MODELS: list[tuple[str, type, set[str]]] = [
    ("listener", Listener, set()),
    ("endpoint", Endpoint, set()),
    ("destination", Destination, set()),
    ("topic", Topic, set()),
    ("qos", Qos, set()),
    ("route", Route, {"case", "no_deadman", "no_ttl", "source_topics"}),
    ("deadman", Deadman, set()),
    ("collect", Collect, set()),
    ("gateway", Gateway, {"address", "zenoh"}),
    ("zenoh", ZenohSettings, set()),
    ("inbound", Inbound, {"topic", "no_ttl"}),
    ("inbound_deadman", InboundDeadman, set()),
]
"""Definitions, the classes that declare their keys, and which of the fields are no keys of their own."""
WITHIN = {("deadman", "none"), ("gateway", "ignore"), ("route", "topic")}
"""Keys that are read with the mapping that they stand in."""


def properties(definition: str) -> dict[str, Any]:
    """What a mapping may have; of the kinds of a part the one that is a mapping."""
    schema = table_schema()["definitions"][definition]
    found = next(part["properties"] for part in (schema, schema.get("then", {}), schema.get("else", {}))
                 if "properties" in part)  # fmt: skip
    return dict(found)


@pytest.mark.parametrize(("definition", "model", "others"), MODELS)
def test_the_model_declares_the_keys_of_the_schema(definition: str, model: type, others: set[str]) -> None:
    declared = {key.name.partition(".")[0] for key in keys_of(model) if key.attribute not in others | {"name"}}
    inherited = {key.name for key in keys_of(Topic)} if model is Inbound else set()
    known = {name for name in properties(definition) if (definition, name) not in WITHIN}
    assert (declared - known, known - declared - inherited) == (set(), set())


def test_documented_defaults_are_those_of_the_model() -> None:
    named = [(model, properties(definition)) for definition, model, _ in MODELS]
    top = table_schema()["properties"]
    compared = 0
    for model, known in [
        *named,
        (RecordSettings, top["record"]["properties"]),
        (NodeSettings, top["node"]["properties"]),
    ]:
        for key in keys_of(model):
            outer, _, inner = key.name.partition(".")
            declared = resolved(known.get(outer, {}))
            documented = resolved(declared.get("properties", {}).get(inner, {}) if inner else declared).get("default")
            if documented not in (None, [], {}) and key.default is not None:
                assert key.text(key.default).replace(" ", "").lower() == str(documented).lower(), (model, key.name)
                compared += 1
    assert compared > 20
    assert top["node"]["default"] == {"name": NodeSettings().name, "namespace": NodeSettings().namespace}
