"""What generated code calls to read strings and lists, and what it makes of messages in lists.

Takes bytes that were cut out of a message and may be anything. What they cannot mean raises MappingError,
or struct.error, or UnicodeDecodeError.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from operator import itemgetter

from router.errors import MappingError
from router.types.model import MessageType

_KNOWN = {
    b"\x00\x00": "CDR_BE", b"\x00\x02": "PL_CDR_BE", b"\x00\x03": "PL_CDR_LE", b"\x00\x06": "CDR2_BE",
    b"\x00\x07": "CDR2_LE", b"\x00\x08": "D_CDR2_BE", b"\x00\x09": "D_CDR2_LE", b"\x00\x0a": "PL_CDR2_BE",
    b"\x00\x0b": "PL_CDR2_LE",
}  # fmt: skip
"""Representation identifiers of DDS-XTypes 1.3, table 60, that are not read."""


def refuse(representation: bytes) -> None:
    """Raises MappingError for a message in another representation than CDR_LE, or without any."""
    name = _KNOWN.get(representation, "of an unknown kind")
    raise MappingError(f"the message is {name} (0x{representation.hex()}), not CDR_LE")


def cut_off(cdr: bytes) -> None:
    """Raises MappingError for a message that ends before its last field does."""
    raise MappingError(f"the message ends after {len(cdr)} bytes, within a string or list")


def text(data: bytes) -> str:
    """A string from its bytes with the final NUL. Some writers leave it out where the string is empty."""
    if data and data[-1]:
        raise MappingError("a string does not end with NUL")
    return data[:-1].decode()


def wide_text(data: bytes) -> str:
    """A wstring from its UTF-16 code units of 32 bits each."""
    units = numbers("I", 4, data)
    return struct.pack(f"<{len(units)}H", *units).decode("utf-16-le")


def texts(many: Iterable[bytes]) -> list[str]:
    return [text(data) for data in many]


def wide_texts(many: Iterable[bytes]) -> list[str]:
    return [wide_text(data) for data in many]


def numbers(letter: str, size: int, data: bytes) -> tuple[int | float, ...]:
    """Scalars in a row; `size` is that of one."""
    return struct.unpack(f"<{len(data) // size}{letter}", data)


def object_class(declared: MessageType) -> type[tuple[object, ...]]:
    """A class whose objects are made of a tuple of all fields and have those as attributes.

    A tuple below, because nothing else is made as quickly. Fields may be called as Python keywords are.
    """
    fields = {member.name: property(itemgetter(index)) for index, member in enumerate(declared.fields)}
    return type(declared.short_name, (tuple,), {"__slots__": (), **fields})
