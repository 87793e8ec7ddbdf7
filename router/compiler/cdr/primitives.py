"""Formats of CDR scalars, and the functions that generated code calls to read and write strings, lists and lengths.

Readers take bytes that were cut out of a message and may be anything. Writers append to `data`, the message without
its header, so that offsets into it are what alignment counts. What cannot be read or written raises MappingError,
struct.error or UnicodeError.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Sequence
from operator import itemgetter
from typing import Any

from router.errors import MappingError
from router.types.model import Bool, Float, Int, List, MessageType, String, Type

HEADER = b"\x00\x01\x00\x00"
"""Representation identifier CDR_LE and two option bytes."""

CDR_LE = HEADER[:2]

_PADDING = tuple(bytes(count) for count in range(8))
_INTEGERS = {8: "B", 16: "H", 32: "I", 64: "Q"}
_OTHERS = {
    b"\x00\x00": "CDR_BE", b"\x00\x02": "PL_CDR_BE", b"\x00\x03": "PL_CDR_LE", b"\x00\x06": "CDR2_BE",
    b"\x00\x07": "CDR2_LE", b"\x00\x08": "D_CDR2_BE", b"\x00\x09": "D_CDR2_LE", b"\x00\x0a": "PL_CDR2_BE",
    b"\x00\x0b": "PL_CDR2_LE",
}  # fmt: skip
"""Representation identifiers of DDS-XTypes 1.3, table 60, that are not read."""


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


# reading


def refuse(representation: bytes) -> None:
    """Raise MappingError for a message in another representation than CDR_LE, or in none."""
    name = _OTHERS.get(representation, "of an unknown kind")
    raise MappingError(f"the message is {name} (0x{representation.hex()}), not CDR_LE")


def cut_off(cdr: bytes) -> None:
    """Raise MappingError for a message that ends before its last field."""
    raise MappingError(f"the message ends after {len(cdr)} bytes, within a string or list")


def read_text(data: bytes) -> str:
    """A string from its bytes with the final NUL, which some writers leave out of empty strings."""
    if data and data[-1]:
        raise MappingError("a string does not end with NUL")
    return data[:-1].decode()


def read_wide_text(data: bytes) -> str:
    """A wstring from its UTF-16 code units of 32 bits each."""
    units = numbers("I", 4, data)
    return struct.pack(f"<{len(units)}H", *units).decode("utf-16-le")


def read_texts(many: Iterable[bytes]) -> list[str]:
    return [read_text(data) for data in many]


def read_wide_texts(many: Iterable[bytes]) -> list[str]:
    return [read_wide_text(data) for data in many]


def numbers(letter: str, size: int, data: bytes) -> tuple[int | float, ...]:
    """Scalars of `size` bytes each."""
    return struct.unpack(f"<{len(data) // size}{letter}", data)


def decoder(declared: Type) -> Callable[[Any], object] | None:
    """The function that decodes the text of a field, None for other types."""
    match declared:
        case String():
            return read_wide_text if declared.wide else read_text
        case List(element=String(wide=wide)):
            return read_wide_texts if wide else read_texts
        case _:
            return None


def object_class(declared: MessageType) -> type[tuple[object, ...]]:
    """A class whose objects are made of a tuple of all fields, which are its attributes.

    Text in the tuple is not decoded, text that an attribute gives is. It is a tuple since that is the fastest to make.
    Fields may have the names of Python keywords.
    """
    fields = {member.name: property(_getter(index, member.type)) for index, member in enumerate(declared.fields)}
    return type(declared.short_name, (tuple,), {"__slots__": (), **fields})


def _getter(index: int, declared: Type) -> Callable[[Any], object]:
    decode = decoder(declared)
    return itemgetter(index) if decode is None else lambda values: decode(values[index])


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
