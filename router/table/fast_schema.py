"""Fast check of whether data fits a JSON Schema, by functions made from the schema.

Nearly every table fits. jsonschema takes 20 times as long to find that out, and its import takes as long as the check
of a table, so schema.py uses it only for data that does not fit. fastjsonschema generates Python from a schema, which
would have to be compiled at each start.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from typing import Any

Fits = Callable[[Any], bool]


def fitting(schema: Mapping[str, Any]) -> Fits:
    """Return a function that returns whether data fits a schema of draft 7, with the keywords that our schemas use.

    References lead to the schema's own `definitions`. It treats 1 and true as equal items of a list.
    """
    return _Maker(schema["definitions"]).of(schema)


class _Maker:
    def __init__(self, definitions: Mapping[str, Any]) -> None:
        self._definitions = definitions
        self._made: dict[str, Fits] = {}

    def of(self, schema: Mapping[str, Any] | bool) -> Fits:
        if isinstance(schema, bool):
            return lambda _: schema
        if "$ref" in schema:  # other keywords beside it are ignored
            return self._reference(schema["$ref"].removeprefix("#/definitions/"))
        checks = [_KEYWORDS[keyword](self, limit, schema) for keyword, limit in schema.items() if keyword in _KEYWORDS]
        if unknown := schema.keys() - _KEYWORDS.keys() - _OTHERS:
            raise NotImplementedError(f"the schema uses {', '.join(sorted(unknown))}")
        return checks[0] if len(checks) == 1 else _all_of(checks)

    def all(self, schemas: Collection[Any]) -> list[Fits]:
        return [self.of(schema) for schema in schemas]

    def _reference(self, name: str) -> Fits:
        """Return the check of a definition, made on first use because it may refer to itself."""

        def fits(value: object) -> bool:
            if name not in self._made:
                self._made[name] = self.of(self._definitions[name])
            return self._made[name](value)

        return fits


def _all_of(parts: Collection[Fits]) -> Fits:
    def fits(value: object) -> bool:
        for part in parts:  # noqa: SIM110 - a generator takes twice as long
            if not part(value):
                return False
        return True

    return fits


def _any_of(parts: Collection[Fits]) -> Fits:
    return lambda value: any(part(value) for part in parts)


def _not(part: Fits) -> Fits:
    return lambda value: not part(value)


def _if(maker: _Maker, condition: Any, schema: Mapping[str, Any]) -> Fits:
    holds, then, otherwise = maker.all([condition, schema.get("then", True), schema.get("else", True)])
    return lambda value: then(value) if holds(value) else otherwise(value)


def _members(maker: _Maker, _: Any, schema: Mapping[str, Any]) -> Fits:
    """Check the members of a mapping, those in `properties` and others."""
    known = {name: maker.of(part) for name, part in schema.get("properties", {}).items()}
    other = maker.of(schema.get("additionalProperties", True))

    def fits(value: object) -> bool:
        if isinstance(value, dict):
            for name, member in value.items():
                if not known.get(name, other)(member):
                    return False
        return True

    return fits


def _type(names: str | list[str]) -> Fits:
    kinds = [_TYPES[name] for name in ([names] if isinstance(names, str) else names)]
    return kinds[0] if len(kinds) == 1 else _any_of(kinds)


_TYPES: Mapping[str, Fits] = {
    "object": lambda value: isinstance(value, dict),
    "array": lambda value: isinstance(value, list),
    "string": lambda value: isinstance(value, str),
    "boolean": lambda value: isinstance(value, bool),
    "null": lambda value: value is None,
    "number": lambda value: isinstance(value, (int, float)) and not isinstance(value, bool),
    "integer": lambda value: (
        (isinstance(value, int) and not isinstance(value, bool)) or (isinstance(value, float) and value.is_integer())
    ),
}


def _is_one_of(limits: Collection[Any]) -> Fits:
    """Check that a value is one of these scalars. True does not equal 1."""
    return lambda value: any(value == limit and isinstance(value, bool) is isinstance(limit, bool) for limit in limits)


def exact_pattern(pattern: str) -> str:
    """Translate `$` at the end: in JSON Schema it is the very end of the text, in Python a line end may follow."""
    return pattern[:-1] + r"\Z" if pattern.endswith("$") else pattern


def _pattern(limit: str) -> Fits:
    pattern = exact_pattern(limit)  # compiled on first use
    return lambda text: re.search(pattern, text) is not None


def _are_unique(items: list[Any]) -> bool:
    return not any(item in items[:index] for index, item in enumerate(items))


def _of(kind: str, make: Callable[[Any], Fits]) -> Callable[[_Maker, Any, Mapping[str, Any]], Fits]:
    """Return a keyword that constrains values of one type; values of other types fit."""
    is_concerned = _TYPES[kind]

    def keyword(_: _Maker, limit: Any, __: Mapping[str, Any]) -> Fits:
        fits = make(limit)
        return lambda value: not is_concerned(value) or fits(value)

    return keyword


def _each(kind: str, is_met: Callable[[Fits, Any], bool]) -> Callable[[_Maker, Any, Mapping[str, Any]], Fits]:
    """Return a keyword that constrains the members of values of one type."""

    def keyword(maker: _Maker, limit: Any, _: Mapping[str, Any]) -> Fits:
        part = maker.of(limit)
        return _of(kind, lambda part: lambda value: is_met(part, value))(maker, part, {})

    return keyword


_KEYWORDS: Mapping[str, Callable[[_Maker, Any, Mapping[str, Any]], Fits]] = {
    "type": lambda _, limit, __: _type(limit),
    "enum": lambda _, limit, __: _is_one_of(limit),
    "const": lambda _, limit, __: _is_one_of([limit]),
    "pattern": _of("string", _pattern),
    "minLength": _of("string", lambda limit: lambda text: len(text) >= limit),
    "minimum": _of("number", lambda limit: lambda number: not number < limit),
    "maximum": _of("number", lambda limit: lambda number: not number > limit),
    "exclusiveMinimum": _of("number", lambda limit: lambda number: not number <= limit),
    "properties": _members,
    "additionalProperties": lambda maker, limit, schema: (
        _all_of([]) if "properties" in schema else _members(maker, limit, schema)
    ),
    "propertyNames": _each("object", lambda part, value: all(map(part, value))),
    "required": _of("object", lambda limit: lambda value: all(name in value for name in limit)),
    "minProperties": _of("object", lambda limit: lambda value: len(value) >= limit),
    "maxProperties": _of("object", lambda limit: lambda value: len(value) <= limit),
    "items": _each("array", lambda part, value: all(map(part, value))),
    "contains": _each("array", lambda part, value: any(map(part, value))),
    "minItems": _of("array", lambda limit: lambda value: len(value) >= limit),
    "uniqueItems": _of("array", lambda limit: _are_unique if limit else _all_of([])),
    "allOf": lambda maker, limit, _: _all_of(maker.all(limit)),
    "anyOf": lambda maker, limit, _: _any_of(maker.all(limit)),
    "not": lambda maker, limit, _: _not(maker.of(limit)),
    "if": _if,
}  # fmt: skip
_OTHERS = frozenset({
    "$schema", "$comment", "title", "description", "default", "examples", "errorMessage", "definitions", "then", "else",
})  # fmt: skip
"""Keywords that do not constrain data, or only together with `if`."""
