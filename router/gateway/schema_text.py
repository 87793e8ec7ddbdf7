"""A message type as the existing gateway describes it to its clients: a JSON schema of its own kind."""

from __future__ import annotations

import json

from router.gateway.style import PLACEHOLDER
from router.types.model import Field, Int, List, MessageType, String, Type

_NOTHING = (Field(PLACEHOLDER, Int(8, signed=False)),)


def schema_text(message: MessageType) -> str:
    """The schema with those of all nested types in it; without spaces, keys sorted, fields in declared order."""
    return json.dumps(_described(message), separators=(",", ":"), sort_keys=True)


def _described(message: MessageType) -> dict[str, object]:
    package, _, name = message.name.rpartition("/")
    return {
        "name": name,
        "namespace": package.replace("/", "::"),
        "fields": [_field(field) for field in message.fields or _NOTHING],
    }


def _field(field: Field) -> dict[str, object]:
    is_array = isinstance(field.type, List)
    element = field.type.element if isinstance(field.type, List) else field.type
    return {
        "name": field.name,
        "is_array": is_array,
        "type": _type_name(element),
        "subtype": _described(element) if isinstance(element, MessageType) else "primitive",
    }


def _type_name(element: Type) -> str:
    """As rosidl calls it: bounds are not part of it, and `char` has become uint8 there already."""
    match element:
        case MessageType():
            return "message"
        case Int(octet=True):
            return "byte"
        case String():
            return "wstring" if element.wide else "string"
        case _:
            return str(element)
