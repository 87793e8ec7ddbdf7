"""The wire format of protobuf, as far as it has to be written by hand, and what protobuf thinks of it."""

from __future__ import annotations

from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass

from router.types.descriptors import container

LEN = 2
"""The wire type of what has a size in front: strings, bytes, messages, packed scalars."""


def varint(value: int) -> bytes:
    """Encode an integer as protobuf encodes tags and lengths."""
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*encoded, value])


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
