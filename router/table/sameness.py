"""Whether two tables say the same, wherever in their files they say it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass

from router.errors import SourceSpan


def are_same(one: object, other: object) -> bool:
    """Compares what is in a table, or was compiled from it, without the places where it was written."""
    return _essence(one) == _essence(other)


def _essence(value: object) -> object:
    if isinstance(value, SourceSpan):
        return None
    if is_dataclass(value) and not isinstance(value, type):
        return type(value), *(_essence(getattr(value, field.name)) for field in fields(value))
    if isinstance(value, Mapping):
        return tuple((key, _essence(member)) for key, member in value.items())
    if isinstance(value, (tuple, list)):
        return tuple(map(_essence, value))
    return value
