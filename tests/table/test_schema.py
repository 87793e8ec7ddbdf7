"""The schema file itself: valid, strict, and a description for every key."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jsonschema

from router.table import build_gateways
from router.table.build import DEFAULT_NODE, DEFAULT_RECEIVE_BUFFER
from router.table.build_routes import DEFAULT_REPEAT
from router.table.shape import table_schema
from router.table.units import parse_duration, parse_size


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
        for schema in table_schema()["definitions"].values()
        if isinstance(schema, dict) and schema.get("type") == "object" and "properties" in schema
    ]
    assert closed
    assert all(schema["additionalProperties"] is False for schema in [table_schema(), *closed])


def test_documented_defaults_are_those_of_the_code() -> None:
    properties = table_schema()["properties"]
    assert properties["node"]["default"] == {"name": DEFAULT_NODE.name, "namespace": DEFAULT_NODE.namespace}
    buffer = table_schema()["definitions"]["listener"]["properties"]["receive_buffer"]
    assert parse_size(buffer["default"]) == DEFAULT_RECEIVE_BUFFER
    repeat = table_schema()["definitions"]["deadman"]["else"]["properties"]["repeat"]
    assert parse_duration(repeat["default"]) == DEFAULT_REPEAT


def test_documented_defaults_of_gateways_are_those_of_the_code() -> None:
    definitions = table_schema()["definitions"]
    given = {key: schema.get("default") for key, schema in definitions["gateway"]["properties"].items()}
    assert parse_duration(given["publish_period"]) == build_gateways.DEFAULT_PUBLISH_PERIOD
    assert parse_duration(given["schema_period"]) == build_gateways.DEFAULT_INTERVAL
    assert parse_duration(given["discovery_period"]) == build_gateways.DEFAULT_INTERVAL
    assert parse_size(given["max_datagram"]) == build_gateways.DEFAULT_MAX_DATAGRAM
    assert parse_size(given["max_message"]) == build_gateways.DEFAULT_MAX_MESSAGE
    assert given["max_clients"] == build_gateways.DEFAULT_MAX_CLIENTS
    assert given["max_clients_per_host"] == build_gateways.DEFAULT_MAX_CLIENTS_PER_HOST
    assert definitions["zenoh"]["properties"]["mode"]["default"] == build_gateways.DEFAULT_MODE
    repeat = definitions["inbound_deadman"]["properties"]["repeat"]
    assert parse_duration(repeat["default"]) == DEFAULT_REPEAT


def test_documented_default_formats_are_those_of_the_code() -> None:
    conditions = table_schema()["definitions"]["gateway"]["allOf"]
    formats = {}
    for condition in conditions:
        for part in condition.get("then", {}).get("allOf", ()):
            if "properties" in part:
                [transport] = condition["if"]["properties"]["transport"]["required"]
                formats[transport] = part["properties"]["format"]["default"]
    assert formats == {transport.value: default.value for transport, default in build_gateways.DEFAULT_FORMATS.items()}
