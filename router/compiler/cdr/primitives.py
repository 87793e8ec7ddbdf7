"""Formats of CDR scalars, and functions that write strings, lists and lengths.

They append to `data`, the message without its header, so that offsets into it are what alignment counts. What cannot be
written raises MappingError, struct.error or UnicodeError.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

from router.errors import MappingError
from router.types.model import Bool, Float, Int, Type

HEADER = b"\x00\x01\x00\x00"
"""Representation identifier CDR_LE and two option bytes."""

CDR_LE = HEADER[:2]

_PADDING = tuple(bytes(count) for count in range(8))
_INTEGERS = {8: "B", 16: "H", 32: "I", 64: "Q"}


def scalar_format(declared: Type) -> str:
    """The struct letter of a primitive type other than a string."""
    match declared:
        case Bool():
            return "?"
        case Int():
            letter = _INTEGERS[declared.bits]
            return letter.lower() if declared.signed else letter
        case Float():
            return "f" if declared.bits == 32 else "d"
        case _:
            raise AssertionError(f"{declared} is no scalar of a ROS message")


# writing


def put_text(data: bytearray, text: str) -> None:
    """Append a string: its length with the final NUL, its bytes, the NUL."""
    encoded = text.encode()
    if b"\0" in encoded:
        raise MappingError("a ROS string cannot hold a NUL")
    data += _PADDING[-len(data) & 3]
    data += struct.pack("<I", len(encoded) + 1)
    data += encoded
    data += b"\0"


def put_wide_text(data: bytearray, text: str) -> None:
    """Append a wstring: its length in UTF-16 code units, and each of those in 32 bits, as rmw_fastrtps does it.

    There is no final NUL.
    """
    encoded = text.encode("utf-16-le")
    units = struct.unpack(f"<{len(encoded) // 2}H", encoded)
    data += _PADDING[-len(data) & 3]
    data += struct.pack(f"<I{len(units)}I", len(units), *units)


def put_numbers(data: bytearray, letter: str, size: int, values: Sequence[object]) -> None:
    """Append the elements of a list of scalars, without its length."""
    if values:
        data += _PADDING[-len(data) % size]
        data += struct.pack(f"<{len(values)}{letter}", *values)


def put_length(data: bytearray, length: int, bound: int | None) -> None:
    """Append the length of a sequence."""
    if bound is not None and length > bound:
        raise MappingError(f"{length} elements are more than {bound}")
    data += _PADDING[-len(data) & 3]
    data += struct.pack("<I", length)


def want_length(length: int, wanted: int) -> None:
    """Raise MappingError if a list is not as long as the array that it fills."""
    if length != wanted:
        raise MappingError(f"{length} elements where an array takes {wanted}")
