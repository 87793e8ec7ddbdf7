"""The wire format of protobuf, as far as it has to be written by hand, and what protobuf thinks of it."""

from __future__ import annotations

from collections.abc import Iterator

from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass

from router.types.descriptors import container

VARINT, I64, LEN, GROUP, GROUP_END, I32 = range(6)
"""The wire types. LEN is that of what has a size in front: strings, bytes, messages, packed scalars."""

I64_SIZE, I32_SIZE = 8, 4
_LONGEST_VARINT = 10


def varint(value: int) -> bytes:
    """Encode an integer as protobuf encodes tags and lengths."""
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*encoded, value])


def read_varint(data: bytes, position: int) -> tuple[int, int]:
    """Return a varint and the position behind it. Raises IndexError for one that is cut or too long."""
    value = 0
    for index in range(_LONGEST_VARINT):
        byte = data[position + index]
        value |= (byte & 0x7F) << (7 * index)
        if byte < 0x80:
            return value, position + index + 1
    raise IndexError


def wire_fields(message: bytes) -> Iterator[tuple[int, int, bytes]]:
    """The fields of a well-formed message: number, wire type, and the value as it is encoded, without a size.

    Groups are left out.
    """
    position, open_groups = 0, 0
    while position < len(message):
        tag, position = read_varint(message, position)
        number, wire_type, start = tag >> 3, tag & 7, position
        if wire_type == GROUP:
            open_groups += 1
            continue
        if wire_type == GROUP_END:
            open_groups -= 1
            continue
        if wire_type == VARINT:
            _, position = read_varint(message, position)
        elif wire_type == LEN:
            size, start = read_varint(message, position)
            position = start + size
        else:
            position += I64_SIZE if wire_type == I64 else I32_SIZE
        if not open_groups:
            yield number, wire_type, message[start:position]


def wire_type_of(field: FieldDescriptor) -> int:
    """The wire type of a field, of a repeated one that of an element by itself."""
    if field.type in _LEN_TYPES:
        return LEN
    if field.type in _I64_TYPES:
        return I64
    return I32 if field.type in _I32_TYPES else VARINT


_LEN_TYPES = (FieldDescriptor.TYPE_STRING, FieldDescriptor.TYPE_BYTES, FieldDescriptor.TYPE_MESSAGE)
_I64_TYPES = (FieldDescriptor.TYPE_DOUBLE, FieldDescriptor.TYPE_FIXED64, FieldDescriptor.TYPE_SFIXED64)
_I32_TYPES = (FieldDescriptor.TYPE_FLOAT, FieldDescriptor.TYPE_FIXED32, FieldDescriptor.TYPE_SFIXED32)


def delimited(number: int, value: bytes) -> bytes:
    """A field with a size in front."""
    return varint(number << 3 | LEN) + varint(len(value)) + value


def parses(message: Descriptor, data: bytes) -> bool:
    """Whether protobuf parses a message. Versions and features differ in details; so it is asked."""
    try:
        GetMessageClass(message).FromString(data)
    except DecodeError:
        return False
    return True


def validates_text(field: FieldDescriptor) -> bool:
    """Whether protobuf refuses a message with something else than UTF-8 in this string: by its syntax and features."""
    return not parses(container(field), delimited(field.number, b"\xff"))
