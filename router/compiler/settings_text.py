"""What a table says as flat text: `transport.key` to value, without places. So two tables can be compared.

Knows how values are told to people; which of them matter is for `differences`.
"""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Iterator, Mapping
from typing import Any

from router.errors import SourceSpan
from router.table.model import Address, Expression, FieldMap, Located, TopicPattern, TopicRate
from router.table.places import TextPlace

_DURATIONS = frozenset((
    "coalesce", "deadline", "discovery_period", "last", "lifespan", "liveliness_lease_duration", "max_age", "period",
    "publish_period", "repeat", "schema_period", "stale_after", "timeout", "ttl",
))  # fmt: skip
"""Keys whose numbers are nanoseconds."""

_PLACES = (SourceSpan, TextPlace)


def flat(value: object, key: str = "") -> dict[str, str]:
    """Every setting in it by its key, those of what is inside with dots; what is not set is left out."""
    return dict(_flat(value, key))


def duration(ns: int) -> str:
    return f"{ns / 1e9:g} s" if ns >= 1_000_000_000 else f"{ns / 1e6:g} ms"


def field_map(fields: FieldMap) -> str:
    """`{brake: true}`."""
    entries = ["auto"] if fields.auto else []
    entries += [f"{'.'.join(entry.path)}: {_expression(entry.value)}" for entry in fields.entries]
    return f"{{{', '.join(entries)}}}"


def _flat(value: object, key: str) -> Iterator[tuple[str, str]]:
    if isinstance(value, Located):
        yield from _flat(value.value, key)
    elif isinstance(value, Mapping):
        for name, inner in value.items():
            yield from _flat(inner, _below(key, name))
    elif dataclasses.is_dataclass(value) and not isinstance(value, (Expression, FieldMap, TopicPattern, TopicRate)):
        for field in dataclasses.fields(value):
            inner = getattr(value, field.name)
            if not isinstance(inner, _PLACES) and inner is not None and inner != ():
                yield from _flat(inner, _below(key, field.name))
    elif value is not None:
        yield key, _text(value, key.rpartition(".")[2])


def _below(key: str, name: str) -> str:
    return f"{key}.{name}" if key else name


def _text(value: Any, key: str) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int) and key in _DURATIONS:
        return duration(value)
    if isinstance(value, enum.Enum):
        return str(value.value)
    if isinstance(value, Expression):
        return _expression(value)
    if isinstance(value, FieldMap):
        return field_map(value)
    if isinstance(value, TopicPattern):
        return value.text
    if isinstance(value, TopicRate):
        return f"{value.pattern.text} every {duration(value.period)}" if value.period else f"{value.pattern.text} each"
    if isinstance(value, tuple) and not isinstance(value, Address):
        return ", ".join(_text(item.value if isinstance(item, Located) else item, key) for item in value)
    return str(value)


def _expression(expression: Expression) -> str:
    if expression.items is not None:
        return f"[{', '.join(_expression(item) for item in expression.items)}]"
    return expression.text
