"""What generated code calls for strings and lists, whose lengths only the message tells.

`data` is always the message without its header, so that offsets into it are what alignment counts. A value that
CDR cannot hold raises MappingError, or struct.error, or UnicodeEncodeError.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

from router.errors import MappingError

_PADDING = tuple(bytes(count) for count in range(8))


def put_text(data: bytearray, text: str) -> None:
    """Appends a string: its length with the final NUL, its bytes, the NUL."""
    encoded = text.encode()
    if b"\0" in encoded:
        raise MappingError("a ROS string cannot hold a NUL")
    data += _PADDING[-len(data) & 3]
    data += struct.pack("<I", len(encoded) + 1)
    data += encoded
    data += b"\0"


def put_wide_text(data: bytearray, text: str) -> None:
    """Appends a wstring: its length in UTF-16 code units, and each of those in 32 bits, as rmw_fastrtps does it.

    There is no final NUL.
    """
    encoded = text.encode("utf-16-le")
    units = struct.unpack(f"<{len(encoded) // 2}H", encoded)
    data += _PADDING[-len(data) & 3]
    data += struct.pack(f"<I{len(units)}I", len(units), *units)


def put_numbers(data: bytearray, letter: str, size: int, values: Sequence[object]) -> None:
    """Appends the elements of a list of scalars, without its length."""
    if values:
        data += _PADDING[-len(data) % size]
        data += struct.pack(f"<{len(values)}{letter}", *values)


def put_length(data: bytearray, length: int, bound: int | None) -> None:
    """Appends the length of a sequence."""
    if bound is not None and length > bound:
        raise MappingError(f"{length} elements are more than {bound}")
    data += _PADDING[-len(data) & 3]
    data += struct.pack("<I", length)


def want_length(length: int, wanted: int) -> None:
    """Raises MappingError when a list is not as long as the array that it fills."""
    if length != wanted:
        raise MappingError(f"{length} elements where an array takes {wanted}")
