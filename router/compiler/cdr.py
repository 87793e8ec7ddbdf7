"""ROS messages as CDR bytes: formats of scalars, strings and lengths, and bytes that are known at compile time.

Plain CDR, little-endian (XCDR1, as in Fast DDS and Cyclone DDS): four bytes of header, then each scalar aligned to its
own size, counted from the end of the header. Writers append to `data`, the message without its header. Invalid values
raise MappingError, struct.error or UnicodeError.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from router.compiler.plan import Each, Items, Leaf, Plan, Record, Unset
from router.errors import MappingError
from router.types.model import Bool, Float, Int, List, MessageType, String, Type, zero

HEADER = b"\x00\x01\x00\x00"
"""Representation identifier CDR_LE and two option bytes."""

CDR_LE = HEADER[:2]

_PADDING = tuple(bytes(count) for count in range(8))
_INTEGERS = {8: "B", 16: "H", 32: "I", 64: "Q"}


def scalar_format(declared: Type) -> str:
    """Return the struct letter of a primitive type other than a string."""
    match declared:
        case Bool():
            return "?"
        case Int():
            letter = _INTEGERS[declared.bits]
            return letter.lower() if declared.signed else letter
        case Float():
            return "f" if declared.bits == 32 else "d"
        case _:
            raise AssertionError(f"{declared} is not a scalar of a ROS message")


def put_text(data: bytearray, text: str) -> None:
    """Append a string: its length including the final NUL, its bytes, and the NUL."""
    encoded = text.encode()
    if b"\0" in encoded:
        raise MappingError("a ROS string cannot hold a NUL")
    put_length(data, len(encoded) + 1)
    data += encoded
    data += b"\0"


def put_wide_text(data: bytearray, text: str) -> None:
    """Append a wstring like rmw_fastrtps: its length in UTF-16 code units, then each unit in 32 bits, without a NUL."""
    encoded = text.encode("utf-16-le")
    units = struct.unpack(f"<{len(encoded) // 2}H", encoded)
    put_length(data, len(units))
    data += struct.pack(f"<{len(units)}I", *units)


def put_length(data: bytearray, length: int) -> None:
    """Append the length of a string or sequence."""
    data += _PADDING[-len(data) & 3]
    data += struct.pack("<I", length)


def put_numbers(data: bytearray, letter: str, size: int, values: Sequence[object]) -> None:
    """Append the elements of a list of scalars, without its length."""
    if values:
        data += _PADDING[-len(data) % size]
        data += struct.pack(f"<{len(values)}{letter}", *values)


# known bytes


class Known(NamedTuple):
    """Bytes, with the alignment of their first scalar."""

    data: bytes
    alignment: int


NO_FIELDS = Known(b"\0", 1)
"""A message without fields: IDL does not allow it, so rosidl adds the byte `structure_needs_at_least_one_member`."""


def known_length(length: int) -> Known:
    """Encode the length of a sequence."""
    return Known(struct.pack("<I", length), 4)


def known_value(value: Any, declared: Type) -> Known:
    """Encode a value of a primitive type."""
    if isinstance(declared, String):
        data = bytearray()
        (put_wide_text if declared.wide else put_text)(data, value)
        return Known(bytes(data), 4)
    letter = scalar_format(declared)
    return Known(struct.pack("<" + letter, value), struct.calcsize(letter))


def known_default(declared: Type, default: Any) -> Iterator[Known]:
    """Encode the value that rclpy's constructor assigns: `default`, or zeros and empty lists if that is None."""
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
            yield known_value(zero(declared) if default is None else default, declared)


# sizes


def message_size(plan: Record) -> tuple[int, bool]:
    """Return the size of the CDR bytes with header, and whether it is exact: strings and sequences count as empty."""
    size, is_exact = 0, True
    for alignment, length, is_known in _sizes(plan):
        size += -size % alignment + length
        is_exact = is_exact and is_known
    return len(HEADER) + size, is_exact


def _sizes(plan: Plan) -> Iterator[tuple[int, int, bool]]:  # noqa: C901 - one case per plan
    """Yield alignment and size of each scalar, or of known bytes, and whether that size is fixed."""
    match plan:
        case Record():
            for _, member in plan.members:
                yield from _sizes(member)
            if not plan.type.fields:
                yield 1, 1, True
        case Unset():
            yield from ((known.alignment, len(known.data), True) for known in known_default(plan.type, plan.default))
        case Leaf(type=String(wide=wide)) if plan.constant is None:
            yield 4, 4 if wide else 5, False
        case Leaf():
            data, alignment = known_value(zero(plan.type) if plan.constant is None else plan.constant, plan.type)
            yield alignment, len(data), True
        case Items():
            if plan.type.length is None:
                yield 4, 4, True
            for item in plan.items:
                yield from _sizes(item)
        case Each():
            yield (4, 4, False) if plan.type.length is None else (1, 0, False)
