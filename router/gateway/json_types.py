"""Message types for clients of a gateway: styles of JSON, schemas, and example messages."""

from __future__ import annotations

import enum
import json
import math
from typing import Any

from router.types.model import Bool, Field, Float, Int, List, MessageType, String, Type

PLACEHOLDER = Field("structure_needs_at_least_one_member", Int(8, signed=False))
"""The field that rosidl gives a message without fields."""


class Style(enum.Enum):
    """How values are written. Both styles have no spaces, and sorted keys."""

    WRAPPED = enum.auto()
    """The style of the C++ gateway: single values are arrays of one; a wstring is a list of UTF-16 units."""
    PLAIN = enum.auto()
    """Single values are bare; a wstring is a string."""


def schema_text(message: MessageType) -> str:
    """Return the JSON schema of a type as the C++ gateway writes it: nested types inline, fields in declared order."""
    return json.dumps(_schema(message), separators=(",", ":"), sort_keys=True)


def _schema(message: MessageType) -> dict[str, object]:
    package, _, name = message.name.rpartition("/")
    fields = message.fields or (PLACEHOLDER,)
    return {"name": name, "namespace": package.replace("/", "::"), "fields": [_field_schema(field) for field in fields]}


def _field_schema(field: Field) -> dict[str, object]:
    is_array = isinstance(field.type, List)
    element = field.type.element if isinstance(field.type, List) else field.type
    return {
        "name": field.name,
        "is_array": is_array,
        "type": _type_name(element),
        "subtype": _schema(element) if isinstance(element, MessageType) else "primitive",
    }


def _type_name(element: Type) -> str:
    """Return the name that rosidl uses, without bounds; a `char` is already a uint8 here."""
    match element:
        case MessageType():
            return "message"
        case Int(octet=True):
            return "byte"
        case String():
            return "wstring" if element.wide else "string"
        case _:
            return str(element)


def example(message: MessageType) -> dict[str, object]:
    """Return a message in plain style with all fields at their declared defaults."""
    return {field.name: _default(field.type, field.default) for field in message.fields}


def _default(declared: Type, default: Any) -> object:
    match declared:
        case MessageType():
            return example(declared)
        case List():
            values = [None] * (declared.length or 0) if default is None else default
            return [_default(declared.element, value) for value in values]
        case Bool():
            return bool(default)
        case String():
            return default or ""
        case Float():
            return default if default is not None and math.isfinite(default) else 0.0  # JSON has no infinity
        case _:
            return default or 0
