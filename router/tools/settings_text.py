"""What a table says as flat text: `transport.key` to value, without places. So two tables can be compared.

Values are told as the table writes them, so that one can be taken over. Which of them matter is for `differences`.
"""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from router.errors import SourceSpan
from router.table.model import Address, Expression, FieldMap, Located, TopicPattern, TopicRate
from router.table.places import TextPlace
from router.table.quantities import (
    data_rate,
    disk_size,
    duration,
    duration_or_never,
    period,
    rate,
    size,
    topic_rate,
)
from router.table.units import NEVER

NUMBERS: Mapping[str, Callable[[Any], str]] = {
    "budget": data_rate,
    "coalesce": duration_or_never,
    "deadline": duration,
    "discovery_period": duration,
    "keep": disk_size,
    "last": duration,
    "lifespan": duration,
    "liveliness_lease_duration": duration,
    "max_age": duration,
    "max_datagram": size,
    "max_message": size,
    "max_rate": rate,
    "max_size": disk_size,
    "publish_period": period,
    "receive_buffer": size,
    "repeat": duration,
    "schema_period": duration,
    "stale_after": duration,
    "timeout": duration,
    "ttl": duration,
}
"""How the numbers of those keys are written that have a unit."""

_WITHOUT = {"stale_after": NEVER}
"""What a table writes for the lack of a setting, where that is a word."""

_PLACES = (SourceSpan, TextPlace)


def flat(value: object, key: str = "") -> dict[str, str]:
    """Every setting in it by its key, those of what is inside with dots; what is not set is left out."""
    return dict(_flat(value, key))


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
            if inner is None:
                inner = _WITHOUT.get(field.name)
            if not isinstance(inner, _PLACES) and inner is not None and inner != ():
                yield from _flat(inner, _below(key, field.name))
    elif value is not None:
        yield key, _text(value, key.rpartition(".")[2])


def _below(key: str, name: str) -> str:
    return f"{key}.{name}" if key else name


def _text(value: Any, key: str) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (int, float)) and key in NUMBERS:
        return NUMBERS[key](value)
    if isinstance(value, enum.Enum):
        return str(value.value)
    if isinstance(value, Expression):
        return _expression(value)
    if isinstance(value, FieldMap):
        return field_map(value)
    if isinstance(value, TopicPattern):
        return f"{{regex: {value.text}}}" if value.is_regex else value.text
    if isinstance(value, TopicRate):
        return f"{value.pattern.text}: {topic_rate(value.period)}"
    if isinstance(value, tuple) and not isinstance(value, Address):
        return ", ".join(_text(item.value if isinstance(item, Located) else item, key) for item in value)
    return str(value)


def _expression(expression: Expression) -> str:
    if expression.items is not None:
        return f"[{', '.join(_expression(item) for item in expression.items)}]"
    return expression.text
