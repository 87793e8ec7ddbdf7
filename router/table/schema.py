"""The JSON Schema of a table, and the errors of a tree of nodes that does not fit it."""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from router.assets import asset
from router.table.fast_schema import Fits, exact_pattern, fitting
from router.table.nodes import Node, Path, to_data

if TYPE_CHECKING:
    from jsonschema import ValidationError
    from jsonschema.protocols import Validator

SCHEMA = "schemas/route-table.schema.json"


@dataclass(frozen=True, slots=True)
class SchemaError:
    """The parts of a jsonschema error that we use: `value` at `path` fails `keyword: limit` of `schema`.

    With `about_name`, the value is the name of the last key of the path.
    """

    path: Path
    keyword: str
    limit: Any
    value: object
    schema: Mapping[str, Any]
    message: str
    about_name: bool

    @classmethod
    def of(cls, raised: ValidationError) -> SchemaError:
        about_name = "propertyNames" in raised.absolute_schema_path
        path: Path = tuple(raised.absolute_path)
        if about_name:
            path = (*path, str(raised.instance))
        schema = raised.schema if isinstance(raised.schema, Mapping) else {}
        keyword, limit = str(raised.validator), raised.validator_value
        return cls(path, keyword, limit, raised.instance, schema, raised.message, about_name)

    @property
    def is_about_keys(self) -> bool:
        """Whether a mapping has missing or unknown keys."""
        return self.keyword in ("required", "additionalProperties")

    @property
    def lacks_mapping(self) -> bool:
        """Whether a key that takes a mapping is empty; its keys may be beside it because they are not indented."""
        return self.keyword == "type" and self.value is None and "object" in self.limit

    @property
    def is_list_in_list(self) -> bool:
        return self.keyword == "type" and isinstance(self.value, list) and isinstance(self.path[-1], int)


def table_schema() -> dict[str, Any]:
    """Return the schema of tables as data."""
    return _schema(SCHEMA)


@functools.lru_cache
def _schema(name: str) -> dict[str, Any]:
    schema: dict[str, Any] = json.loads(asset(name).read_text(encoding="utf-8"))
    return schema


def is_misplaced(name: str, siblings: Collection[str]) -> bool:
    """Return whether a key does not belong beside its siblings: it or they are keys of a table, but not together."""
    mappings = [keys_of(schema) for schema in (table_schema(), *table_schema()["definitions"].values())]
    of_siblings = [keys for keys in mappings if keys.issuperset(siblings)]
    if not siblings or any(name in keys for keys in of_siblings):
        return False
    return bool(of_siblings) or any(name in keys for keys in mappings)


def keys_of(schema: Mapping[str, Any]) -> set[str]:
    """Return the keys of the mappings that a definition describes."""
    parts = (schema, schema.get("then", {}), schema.get("else", {}))
    return {key for part in parts for key in part.get("properties", ())}


def schema_errors(tree: Node, schema: str) -> list[SchemaError]:
    """Return the errors of a tree that does not fit a schema, which is named by its file.

    There is one error per value, preferably about its type, and one per missing key.
    """
    data: Any = to_data(tree)
    if _fits(schema)(data):
        return []
    errors = [SchemaError.of(error) for error in _validator(schema).iter_errors(data)]
    errors.sort(key=lambda error: error.keyword != "type")
    first = {(error.path, error.message if error.is_about_keys else ""): error for error in reversed(errors)}
    return list(first.values())


@functools.lru_cache
def _fits(schema: str) -> Fits:
    return fitting(_schema(schema))


@functools.lru_cache
def _validator(schema: str) -> Validator:
    return validator(_schema(schema))


def validator(schema: Mapping[str, Any]) -> Validator:
    """Return a validator, which finds where data does not fit."""
    from jsonschema import Draft7Validator, validators  # only for tables with errors: see fast_schema.py

    with_exact_end: type[Validator] = validators.extend(Draft7Validator, {"pattern": _pattern})  # type: ignore[no-untyped-call]
    return with_exact_end(schema)


def _pattern(validator: Validator, pattern: str, instance: object, schema: object) -> Iterator[Exception]:
    from jsonschema import ValidationError

    if isinstance(instance, str) and not matches(instance, pattern):
        yield ValidationError(f"{instance!r} does not match {pattern!r}")


def matches(text: str, pattern: str) -> bool:
    """Return whether a text matches a JSON Schema pattern."""
    return bool(re.search(exact_pattern(pattern), text))
