"""Values of messages as people read them, and which of them are a field's default.

A message is anything with its fields as attributes: a protobuf message, or what reference_cdr.parse gives.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence
from typing import Any

from google.protobuf.message import Message

from router.compiler.expressions.functions import NS_PER_SECOND
from router.compiler.namespace import entries
from router.rehearsal.rehearsal import START
from router.table.units import duration
from router.types.model import Bool, Bytes, Enum, Field, Float, Int, List, MessageType, String, Type
from router.values import float_text

TIMES = frozenset({"builtin_interfaces/msg/Time", "google.protobuf.Timestamp"})


def shown(kind: Type, value: Any) -> str:
    """A value as a test would write it, on one line."""
    match kind:
        case MessageType() if kind.name in TIMES:
            return offset(time_of(kind, value) - START)
        case MessageType():
            inner = ", ".join(words(kind, value))
            return f"{{{inner}}}"
        case List():
            return f"[{', '.join(shown(kind.element, item) for item in elements(kind, value))}]"
        case Enum():
            return next((name for name, number in kind.values if number == value), str(value))
        case Float():
            return float_text(float(value), kind.bits)
        case Bool():
            return "true" if value else "false"
        case Bytes():
            return bytes(value).hex() or "empty"
        case String():
            return repr(value)
        case _:
            return str(value)


def offset(ns: int) -> str:
    """A time after the beginning of the test, as a test would write it; negative before."""
    return f"{'-' if ns < 0 else ''}{duration(abs(ns)) if ns else '0 ms'}"


def elements(kind: List, value: Any) -> Sequence[Any]:
    """Of a list; of a protobuf map its entries, by key."""
    element = kind.element
    return entries(value) if isinstance(element, MessageType) and element.is_map_entry else value


def words(kind: MessageType, value: Any) -> Iterator[str]:
    """`name: value` of every field that is not at its default."""
    for field in kind.fields:
        member = getattr(value, field.name)
        if not is_unset(value, field, member):
            yield f"{field.name}: {shown(field.type, member)}"


def default_of(kind: Type, default: object = None) -> Any:
    """What a field holds that nobody filled; of a message the values by name. `default` is the declared one."""
    if default is not None:
        return default
    match kind:
        case MessageType():
            return {field.name: default_of(field.type, field.default) for field in kind.fields}
        case List():
            return [default_of(kind.element) for _ in range(kind.length or 0)]
        case String():
            return ""
        case Bytes():
            return b""
        case Float():
            return 0.0
        case Bool():
            return False
        case _:
            return 0


def is_unset(holder: Any, field: Field, value: Any) -> bool:
    if isinstance(holder, Message) and (field.has_presence or isinstance(field.type, MessageType)):
        return not holder.HasField(field.name)
    return _is_default(field.type, value, default_of(field.type, field.default))


def _is_default(kind: Type, value: Any, default: Any) -> bool:
    if isinstance(kind, MessageType):
        return all(_is_default(field.type, getattr(value, field.name), default[field.name]) for field in kind.fields)
    if isinstance(kind, List):
        same = zip(elements(kind, value), default, strict=False)
        return len(value) == len(default) and all(_is_default(kind.element, one, other) for one, other in same)
    return same_value(kind, default, value)


def same_value(kind: Type, expected: Any, actual: Any) -> bool:
    if isinstance(kind, Float):
        if math.isnan(expected) or math.isnan(actual):
            return math.isnan(expected) and math.isnan(actual)
        letter = "<f" if kind.bits == 32 else "<d"
        return bool(struct.unpack(letter, struct.pack(letter, expected))[0] == actual)
    if isinstance(kind, Int):
        return int(expected) == int(actual)
    return bool(expected == actual)


def time_of(kind: MessageType, value: Any) -> int:
    """A message of TIMES in ns of the wall clock."""
    seconds, nanoseconds = (getattr(value, field.name) for field in kind.fields)
    return int(seconds * NS_PER_SECOND + nanoseconds)
