"""Message types for clients of a gateway: styles of JSON, schemas, and example messages."""

from __future__ import annotations

import enum
import json
import math
from collections import defaultdict
from typing import Any

from router.types.model import Field, Int, List, MessageType, String, Type, default_of

PLACEHOLDER = Field("structure_needs_at_least_one_member", Int(8, signed=False))
"""The field that rosidl gives a message without fields."""


class Style(enum.Enum):
    """How values are written. Both styles have no spaces, and sorted keys."""

    WRAPPED = enum.auto()
    """The style of the C++ gateway: single values are arrays of one; a wstring is a list of UTF-16 units."""
    PLAIN = enum.auto()
    """Single values are bare; a wstring is a string."""


def schema_text(message: MessageType, style: Style) -> str:
    """Return the JSON schema of a type: nested types inline, fields in declared order.

    In the wrapped style it is as the C++ gateway writes it; in the plain style it also has names of values.
    """
    return json.dumps(_schema(message, style), separators=(",", ":"), sort_keys=True)


def _schema(message: MessageType, style: Style) -> dict[str, object]:
    package, _, name = message.name.rpartition("/")
    names = _value_names(message) if style is Style.PLAIN else {}
    fields = [_field_schema(field, style, names.get(field.name)) for field in message.fields or (PLACEHOLDER,)]
    return {"name": name, "namespace": package.replace("/", "::"), "fields": fields}


def _value_names(message: MessageType) -> dict[str, dict[str, str]]:
    """Return by field the names of its values, as far as the constants of the message tell them without doubt.

    ROS does not say which field a constant is for. By convention, its name begins with that of the field; if none does,
    a single integer field has them all. A value with two names has none.
    """
    integers = [field.name for field in message.fields if isinstance(field.type, Int)]
    by_field: dict[str, dict[str, list[str]]] = defaultdict(lambda: defaultdict(list))
    constants = {name: value for name, value in message.constants.items() if type(value) is int}
    for name, value in constants.items():
        owner = max((field for field in integers if name.startswith(f"{field.upper()}_")), key=len, default="")
        if owner:
            by_field[owner][str(value)].append(name[len(owner) + 1 :])
    if not by_field and len(integers) == 1:
        for name, value in constants.items():
            by_field[integers[0]][str(value)].append(name)
    return {
        field: {value: name for value, (name, *others) in values.items() if not others}
        for field, values in by_field.items()
    }


def _field_schema(field: Field, style: Style, names: dict[str, str] | None) -> dict[str, object]:
    is_array = isinstance(field.type, List)
    element = field.type.element if isinstance(field.type, List) else field.type
    return {
        "name": field.name,
        "is_array": is_array,
        "type": _type_name(element),
        "subtype": _schema(element, style) if isinstance(element, MessageType) else "primitive",
        **({"names": names} if names else {}),
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
    return {name: _in_json(value) for name, value in default_of(message).items()}


def _in_json(value: Any) -> object:
    match value:
        case dict():
            return {name: _in_json(member) for name, member in value.items()}
        case list() | tuple():
            return [_in_json(element) for element in value]
        case float() if not math.isfinite(value):
            return 0.0  # JSON has no infinity
    return value
