"""The JSON Schema of a table, and where a tree of nodes does not fit it."""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from router.assets import asset
from router.table.fitting import Fits, exact_pattern, fitting
from router.table.nodes import Node, Path, to_data

if TYPE_CHECKING:
    from jsonschema import ValidationError
    from jsonschema.protocols import Validator

SCHEMA = "schemas/route-table.schema.json"


@dataclass(frozen=True, slots=True)
class SchemaError:
    """What of jsonschema's error is used: `value` at `path` fails `keyword: limit` of `schema`.

    With `about_name` the value is the name of the last key of the path.
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
        """The mapping is one, but some of its keys are missing or too many."""
        return self.keyword in ("required", "additionalProperties")

    @property
    def lacks_mapping(self) -> bool:
        """A key has nothing below it; what should be there may stand beside it, for want of indentation."""
        return self.keyword == "type" and self.value is None and "object" in self.limit

    @property
    def is_list_in_list(self) -> bool:
        return self.keyword == "type" and isinstance(self.value, list) and isinstance(self.path[-1], int)


def table_schema() -> dict[str, Any]:
    """The schema as data."""
    return _schema(SCHEMA)


@functools.lru_cache
def _schema(name: str) -> dict[str, Any]:
    schema: dict[str, Any] = json.loads(asset(name).read_text(encoding="utf-8"))
    return schema


def is_misplaced(name: str, siblings: Collection[str]) -> bool:
    """Whether a key does not belong beside its siblings: either it is one of tables, or they are, but not both."""
    mappings = [keys_of(schema) for schema in (table_schema(), *table_schema()["definitions"].values())]
    of_siblings = [keys for keys in mappings if keys.issuperset(siblings)]
    if not siblings or any(name in keys for keys in of_siblings):
        return False
    return bool(of_siblings) or any(name in keys for keys in mappings)


def keys_of(schema: Mapping[str, Any]) -> set[str]:
    """The keys of the mappings that a definition describes."""
    parts = (schema, schema.get("then", {}), schema.get("else", {}))
    return {key for part in parts for key in part.get("properties", ())}


def schema_errors(tree: Node, schema: str) -> list[SchemaError]:
    """Where a tree does not fit a schema of ours, which is named by its file.

    One error for each value, that of its type before any other; each missing key is one of its own.
    """
    data: Any = to_data(tree)
    if _fits(schema)(data):
        return []
    found = [SchemaError.of(error) for error in _validator(schema).iter_errors(data)]
    found.sort(key=lambda error: error.keyword != "type")
    first = {(error.path, error.message if error.is_about_keys else ""): error for error in reversed(found)}
    return list(first.values())


@functools.lru_cache
def _fits(schema: str) -> Fits:
    return fitting(_schema(schema))


@functools.lru_cache
def _validator(schema: str) -> Validator:
    return validator(_schema(schema))


def validator(schema: Mapping[str, Any]) -> Validator:
    """What knows where data does not fit."""
    from jsonschema import Draft7Validator, validators  # only for tables with errors: see fitting.py

    with_exact_end: type[Validator] = validators.extend(Draft7Validator, {"pattern": _pattern})  # type: ignore[no-untyped-call]
    return with_exact_end(schema)


def _pattern(validator: Validator, pattern: str, instance: object, schema: object) -> Iterator[Exception]:
    from jsonschema import ValidationError

    if isinstance(instance, str) and not matches(instance, pattern):
        yield ValidationError(f"{instance!r} does not match {pattern!r}")


def matches(text: str, pattern: str) -> bool:
    """Whether a text matches a pattern of JSON Schema."""
    return bool(re.search(exact_pattern(pattern), text))
