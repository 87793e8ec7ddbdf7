"""The schema file itself: valid, strict, and a description for every key."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jsonschema

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


def parts(schema: object) -> Iterator[dict[str, Any]]:
    """Every schema within a schema, and other mappings."""
    members = schema.values() if isinstance(schema, dict) else schema if isinstance(schema, list) else ()
    yield from ([schema] if isinstance(schema, dict) else [])
    for member in members:
        yield from parts(member)


def test_references_lead_to_definitions_and_all_are_used() -> None:
    used = {part["$ref"].removeprefix("#/definitions/") for part in parts(table_schema()) if "$ref" in part}
    assert used == {*table_schema()["definitions"]}


def test_a_message_is_beside_the_keyword_that_it_is_about() -> None:
    having = [part for part in parts(table_schema()) if "errorMessage" in part]
    assert len(having) > 50
    assert [part for part in having if not part.keys() & {"type", "pattern", "enum", "minProperties"}] == []
