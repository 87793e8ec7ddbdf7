"""Message types as their installed Python classes describe them: for all that has no `.msg` file.

That is what belongs to services and actions, and what was written in IDL.
"""

from __future__ import annotations

from typing import Any

from rosidl_parser.definition import (  # type: ignore[import-untyped]
    AbstractGenericString,
    AbstractNestedType,
    AbstractWString,
    Array,
    NamespacedType,
)

from router.errors import StartError
from router.ros.types import installed_class
from router.types.model import Bool, Field, Float, Int, List, MessageType, String, Type

_BASIC: dict[str, Type] = {
    "boolean": Bool(),
    "octet": Int(8, signed=False, octet=True),
    "float": Float(32),
    "double": Float(64),
    **{str(it): it for it in (Int(bits, signed) for bits in (8, 16, 32, 64) for signed in (False, True))},
}


def installed_type(name: str) -> MessageType:
    """The type with all types nested in it, without defaults and constants.

    Raises StartError where one of them cannot be loaded, or has a field that no `.msg` file could declare.
    """
    return _message(name, {})


def _message(name: str, known: dict[str, MessageType]) -> MessageType:
    if name not in known:
        found = installed_class(name)
        slots = zip(found.get_fields_and_field_types(), found.SLOT_TYPES, strict=True)
        known[name] = MessageType(
            name, tuple(Field(field, _type(slot, f"{name}.{field}", known)) for field, slot in slots)
        )
    return known[name]


def _type(slot: Any, place: str, known: dict[str, MessageType]) -> Type:
    if isinstance(slot, AbstractNestedType):
        element = _type(slot.value_type, place, known)
        if isinstance(slot, Array):
            return List(element, length=slot.size)
        return List(element, bound=getattr(slot, "maximum_size", None))
    if isinstance(slot, NamespacedType):
        return _message("/".join(slot.namespaced_name()), known)
    if isinstance(slot, AbstractGenericString):
        return String(getattr(slot, "maximum_size", None), wide=isinstance(slot, AbstractWString))
    if (basic := _BASIC.get(slot.typename)) is None:
        raise StartError(f"{place} is a {slot.typename}, which the router cannot read")
    return basic
