"""The wire format of protobuf, as far as we encode it by hand, and checks of what protobuf parses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass

from router.declared import FieldType, Op
from router.types.descriptors import container
from router.types.model import Bool, Float, Int, Type

VARINT, I64, LEN, GROUP, GROUP_END, I32 = range(6)
"""The wire types. LEN is for values with a length prefix: strings, bytes, messages, packed scalars."""

I64_SIZE, I32_SIZE = 8, 4
_LONGEST_VARINT = 10
_ALL_BITS = (1 << 64) - 1


class Encoding(NamedTuple):
    """The encoding of one of protobuf's types.

    `read` and `write` are those of the carrier. `size` is the largest encoding of a number in bytes, `type` its type in
    the model.
    """

    wire_type: int
    read: FieldType
    write: Op
    size: int = 0
    type: Type | None = None


_SIGNED_32, _SIGNED_64, _UNSIGNED_32, _UNSIGNED_64 = (
    Int(bits, signed) for signed in (True, False) for bits in (32, 64)
)
_ENCODINGS: Mapping[int, Encoding] = {
    FieldDescriptor.TYPE_BOOL: Encoding(VARINT, FieldType.BOOL, Op.WRITE_VARINT, 1, Bool()),
    FieldDescriptor.TYPE_ENUM: Encoding(VARINT, FieldType.INT32, Op.WRITE_VARINT),
    FieldDescriptor.TYPE_INT32: Encoding(VARINT, FieldType.INT32, Op.WRITE_VARINT, 10, _SIGNED_32),
    FieldDescriptor.TYPE_INT64: Encoding(VARINT, FieldType.INT64, Op.WRITE_VARINT, 10, _SIGNED_64),
    FieldDescriptor.TYPE_UINT32: Encoding(VARINT, FieldType.UINT32, Op.WRITE_VARINT, 5, _UNSIGNED_32),
    FieldDescriptor.TYPE_UINT64: Encoding(VARINT, FieldType.INT64, Op.WRITE_VARINT, 10, _UNSIGNED_64),
    FieldDescriptor.TYPE_SINT32: Encoding(VARINT, FieldType.SINT32, Op.WRITE_ZIGZAG, 5, _SIGNED_32),
    FieldDescriptor.TYPE_SINT64: Encoding(VARINT, FieldType.SINT64, Op.WRITE_ZIGZAG, 10, _SIGNED_64),
    FieldDescriptor.TYPE_FIXED32: Encoding(I32, FieldType.FIXED32, Op.WRITE_FIXED32, 4, _UNSIGNED_32),
    FieldDescriptor.TYPE_SFIXED32: Encoding(I32, FieldType.SFIXED32, Op.WRITE_FIXED32, 4, _SIGNED_32),
    FieldDescriptor.TYPE_FIXED64: Encoding(I64, FieldType.FIXED64, Op.WRITE_FIXED64, 8, _UNSIGNED_64),
    FieldDescriptor.TYPE_SFIXED64: Encoding(I64, FieldType.FIXED64, Op.WRITE_FIXED64, 8, _SIGNED_64),
    FieldDescriptor.TYPE_FLOAT: Encoding(I32, FieldType.FLOAT, Op.WRITE_FLOAT, 4, Float(32)),
    FieldDescriptor.TYPE_DOUBLE: Encoding(I64, FieldType.DOUBLE, Op.WRITE_DOUBLE, 8, Float(64)),
    FieldDescriptor.TYPE_STRING: Encoding(LEN, FieldType.BYTES, Op.WRITE_BYTES),
    FieldDescriptor.TYPE_BYTES: Encoding(LEN, FieldType.BYTES, Op.WRITE_BYTES),
    FieldDescriptor.TYPE_MESSAGE: Encoding(LEN, FieldType.MESSAGE, Op.OPEN),
    FieldDescriptor.TYPE_GROUP: Encoding(GROUP, FieldType.GROUP, Op.OPEN),
}


def encoding_of(field: FieldDescriptor) -> Encoding:
    """Return the encoding of a field, or of a single element of a repeated one."""
    return encoding(field.type)


def encoding(kind: int) -> Encoding:
    """Return the encoding of one of FieldDescriptor.TYPE_*."""
    return _ENCODINGS[kind]


def varint(value: int) -> bytes:
    """Encode an integer as a varint, a negative one as its 64 bits."""
    encoded = bytearray()
    value &= _ALL_BITS
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*encoded, value])


def read_varint(data: bytes, position: int) -> tuple[int, int]:
    """Return a varint and the position after it. Raises IndexError if it is truncated or too long."""
    value = 0
    for index in range(_LONGEST_VARINT):
        byte = data[position + index]
        value |= (byte & 0x7F) << (7 * index)
        if byte < 0x80:
            return value, position + index + 1
    raise IndexError


def delimited(number: int, value: bytes) -> bytes:
    """Encode a field with a length prefix."""
    return varint(number << 3 | LEN) + varint(len(value)) + value


def parses(message: Descriptor, data: bytes) -> bool:
    """Return whether protobuf parses a message. Tries it, because versions and features differ in details."""
    try:
        GetMessageClass(message).FromString(data)
    except DecodeError:
        return False
    return True


def validates_text(field: FieldDescriptor) -> bool:
    """Return whether protobuf rejects a message if this string is not UTF-8, which depends on syntax and features."""
    return not parses(container(field), delimited(field.number, b"\xff"))
