"""Hypothesis strategies: messages as bytes that protobuf parses, with fields in any order, several times, or unknown."""

from __future__ import annotations

import math
import struct
from functools import cache

from google.protobuf.descriptor import Descriptor, FieldDescriptor
from hypothesis import strategies as st

from router.types.descriptors import message_of
from router.types.wire import parses
from tests.engine.wire import I32, I64, LEN, VARINT, tag, varint

GROUP, GROUP_END = 3, 4
_DEEPEST = 3

_F = FieldDescriptor
_FIXED32 = {_F.TYPE_FIXED32, _F.TYPE_SFIXED32, _F.TYPE_FLOAT}
_FIXED64 = {_F.TYPE_FIXED64, _F.TYPE_SFIXED64, _F.TYPE_DOUBLE}
_ZIGZAG = {_F.TYPE_SINT32, _F.TYPE_SINT64}

_INTEGERS = (0, 0, 1, 2, 3, 9, -1, -7, 127, 128, 255, 256, 300, 32767, -32769, (1 << 24) + 1, (1 << 31) - 1, -(1 << 31),
             (1 << 32) - 1, 1 << 32, (1 << 53) + 1, (1 << 63) - 1, -(1 << 63), (1 << 64) - 1)  # fmt: skip
_FLOATS = (0.0, -0.0, 0.5, 1.0, -1.5, 2.5, 90.0, 360.5, 1e-45, 1e38, -3.4028234663852886e38, 1e9, 1.7e308, -1e300, 5e-324,
           math.inf, -math.inf, math.nan)  # fmt: skip
_TEXTS = ("", "", "a", "é", "\0", "abcdefgh" * 3, "\U0001f600", "\uffff", "a\0b")
_NOT_UTF8 = (b"\xff", b"\xed\xa0\x80", b"a\xc3")
_INTEGER = st.sampled_from(_INTEGERS) | st.integers(-(1 << 63), (1 << 64) - 1)
_SINGLE = st.sampled_from(
    [struct.pack("<f", each) for each in _FLOATS if abs(each) < 3.5e38 or not math.isfinite(each)]
)
_DOUBLE = st.sampled_from([struct.pack("<d", each) for each in _FLOATS])
_TEXT = st.sampled_from([*(text.encode() for text in _TEXTS), b"x" * 300])


@cache
def messages(descriptor: Descriptor) -> st.SearchStrategy[bytes]:
    """Those that protobuf parses."""
    return _message(descriptor, _DEEPEST).filter(lambda data: parses(descriptor, data))


@cache
@st.composite
def _message(draw: st.DrawFn, descriptor: Descriptor, depth: int) -> bytes:
    fields = [field for field in descriptor.fields if depth or field.message_type is None]
    count = draw(st.sampled_from([0, 1, 2, 3, 5, min(12, len(fields))])) if fields else 0
    parts = [draw(_field(draw(st.sampled_from(fields)), depth)) for _ in range(count)]
    if draw(st.integers(0, 9)) == 9:
        parts.append(tag(draw(st.sampled_from([18999, 77])), LEN) + b"\x02\x08\x01")
    return b"".join(parts)


@cache
@st.composite
def _field(draw: st.DrawFn, field: FieldDescriptor, depth: int) -> bytes:
    if field.type == _F.TYPE_GROUP:
        inner = draw(_message(message_of(field), depth - 1))
        return tag(field.number, GROUP) + inner + tag(field.number, GROUP_END)
    if field.message_type is not None:
        return _delimited(field.number, draw(_message(message_of(field), depth - 1)))
    if field.type in {_F.TYPE_STRING, _F.TYPE_BYTES}:
        return _delimited(field.number, draw(_TEXT | st.sampled_from(_NOT_UTF8)))
    if field.is_repeated and draw(st.booleans()):
        return _delimited(field.number, b"".join(draw(st.lists(_scalar(field), max_size=4))))
    wire_type = I32 if field.type in _FIXED32 else I64 if field.type in _FIXED64 else VARINT
    return tag(field.number, wire_type) + draw(_scalar(field))


def _scalar(field: FieldDescriptor) -> st.SearchStrategy[bytes]:
    if field.type == _F.TYPE_FLOAT:
        return _SINGLE | st.binary(min_size=4, max_size=4)
    if field.type == _F.TYPE_DOUBLE:
        return _DOUBLE | st.binary(min_size=8, max_size=8)
    if field.type in _FIXED32:
        return _INTEGER.map(lambda number: struct.pack("<I", number & 0xFFFF_FFFF))
    if field.type in _FIXED64:
        return _INTEGER.map(lambda number: struct.pack("<Q", number & (1 << 64) - 1))
    if field.enum_type is not None:
        numbers = [value.number for value in field.enum_type.values]
        return (st.sampled_from(numbers) | st.sampled_from(_INTEGERS)).map(_varint)
    return _INTEGER.map(_zigzag if field.type in _ZIGZAG else _varint)


def _varint(number: int) -> bytes:
    return varint(number & (1 << 64) - 1)


def _zigzag(number: int) -> bytes:
    return varint((number << 1 ^ number >> 63) & (1 << 64) - 1)


def _delimited(number: int, content: bytes) -> bytes:
    return tag(number, LEN) + varint(len(content)) + content
