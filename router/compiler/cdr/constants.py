"""CDR bytes that are known when the table is read: literals, lengths of list literals, and defaults."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any, NamedTuple

from router.compiler.cdr.primitives import put_text, put_wide_text, scalar_format
from router.types.model import Bool, Float, List, MessageType, String, Type


class Known(NamedTuple):
    """Bytes, with the alignment of their first scalar."""

    data: bytes
    alignment: int


NO_FIELDS = Known(b"\0", 1)
"""A message without fields: IDL has none, so rosidl adds the byte `structure_needs_at_least_one_member`."""


def known_length(length: int) -> Known:
    """The length in front of a sequence."""
    return Known(struct.pack("<I", length), 4)


def known_value(value: Any, declared: Type) -> Known:
    """A value of a primitive type."""
    if isinstance(declared, String):
        data = bytearray()
        (put_wide_text if declared.wide else put_text)(data, value)
        return Known(bytes(data), 4)
    letter = scalar_format(declared)
    return Known(struct.pack("<" + letter, value), struct.calcsize(letter))


def known_default(declared: Type, default: Any) -> Iterator[Known]:
    """The value that rclpy's constructor gives a field: `default`, or zeros and empty lists if that is None."""
    match declared:
        case MessageType():
            for member in declared.fields:
                yield from known_default(member.type, member.default)
            if not declared.fields:
                yield NO_FIELDS
        case List():
            values = [None] * (declared.length or 0) if default is None else default
            if declared.length is None:
                yield known_length(len(values))
            for value in values:
                yield from known_default(declared.element, value)
        case _:
            yield known_value(_zero(declared) if default is None else default, declared)


def _zero(declared: Type) -> object:
    match declared:
        case Bool():
            return False
        case Float():
            return 0.0
        case String():
            return ""
        case _:
            return 0
