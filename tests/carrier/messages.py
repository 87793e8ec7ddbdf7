"""Random messages that protobuf parses: with fields in any order, repeated, or unknown."""

from __future__ import annotations

import math
import random
import struct
from functools import cache

from google.protobuf.descriptor import Descriptor, FieldDescriptor
from hypothesis import strategies as st

from router.types.protobuf import PayloadCase
from router.types.wire import delimited, parses
from tests.envelopes import I32, I64, LEN, VARINT, tag, varint

GROUP, GROUP_END = 3, 4
_DEEPEST = 3

_F = FieldDescriptor
_FIXED32 = {_F.TYPE_FIXED32, _F.TYPE_SFIXED32, _F.TYPE_FLOAT}
_FIXED64 = {_F.TYPE_FIXED64, _F.TYPE_SFIXED64, _F.TYPE_DOUBLE}
_ZIGZAG = {_F.TYPE_SINT32, _F.TYPE_SINT64}

_INTEGERS = (0, 0, 1, 2, 3, 9, -1, -7, 127, 128, 255, 256, 300, 32767, -32769, (1 << 24) + 1, (1 << 31) - 1, -(1 << 31),
             (1 << 32) - 1, 1 << 32, (1 << 53) + 1, (1 << 63) - 1, -(1 << 63), (1 << 64) - 1)  # fmt: skip
_FLOATS = (0.0, -0.0, 0.5, 1.0, -1.5, 2.5, 90.0, 360.5, 1e-45, 1e38, -3.4028234663852886e38, 1e9, 1.7e308, -1e300,
           5e-324, math.inf, -math.inf, math.nan)  # fmt: skip
_TEXTS = ("", "", "a", "é", "\0", "abcdefgh" * 3, "\U0001f600", "\uffff", "a\0b")
_NOT_UTF8 = (b"\xff", b"\xed\xa0\x80", b"a\xc3")
_SINGLES = [struct.pack("<f", each) for each in _FLOATS if abs(each) < 3.5e38 or not math.isfinite(each)]
_DOUBLES = [struct.pack("<d", each) for each in _FLOATS]
_STRINGS = [*(text.encode() for text in _TEXTS), b"x" * 300]


def payloads(case: PayloadCase) -> st.SearchStrategy[list[bytes]]:
    """Lists of payloads. They do not shrink, but are quick to generate."""
    return st.integers(0, (1 << 64) - 1).map(lambda seed: some_payloads(case, seed))


def some_payloads(case: PayloadCase, seed: int) -> list[bytes]:
    """At most ten payloads, all accepted by protobuf."""
    descriptor: Descriptor = case.message_class.DESCRIPTOR  # type: ignore[assignment]  # or upb's
    noise = random.Random(seed)
    return [data for _ in range(10) if parses(descriptor, data := _message(noise, descriptor, _DEEPEST))]


@cache
def _fields(descriptor: Descriptor) -> list[FieldDescriptor]:
    return list(descriptor.fields)


def _message(noise: random.Random, descriptor: Descriptor, depth: int) -> bytes:
    fields = _fields(descriptor)
    count = noise.choice((0, 1, 2, 3, 5, len(fields), 2 * len(fields))) if fields else 0
    parts = [_field(noise, noise.choice(fields), depth) for _ in range(count)]
    if noise.random() < 0.1:
        parts.append(tag(noise.choice((18999, 77)), LEN) + b"\x02\x08\x01")
    return b"".join(parts)


def _field(noise: random.Random, field: FieldDescriptor, depth: int) -> bytes:
    if field.message_type is not None:
        inner = _message(noise, field.message_type, depth - 1) if depth else b""
        if field.type == _F.TYPE_GROUP:
            return tag(field.number, GROUP) + inner + tag(field.number, GROUP_END)
        return delimited(field.number, inner)
    if field.type in {_F.TYPE_STRING, _F.TYPE_BYTES}:
        is_text = noise.random() < 0.95
        return delimited(field.number, noise.choice(_STRINGS if is_text else _NOT_UTF8))
    if field.is_repeated and noise.random() < 0.5:
        return delimited(field.number, b"".join(_scalar(noise, field) for _ in range(noise.randrange(5))))
    wire_type = I32 if field.type in _FIXED32 else I64 if field.type in _FIXED64 else VARINT
    return tag(field.number, wire_type) + _scalar(noise, field)


def _scalar(noise: random.Random, field: FieldDescriptor) -> bytes:
    is_edge = noise.random() < 0.6
    real = round(noise.uniform(-1000, 1000), noise.randrange(4))
    if field.type == _F.TYPE_FLOAT:
        return noise.choice(_SINGLES) if is_edge else noise.choice((noise.randbytes(4), struct.pack("<f", real)))
    if field.type == _F.TYPE_DOUBLE:
        return noise.choice(_DOUBLES) if is_edge else noise.choice((noise.randbytes(8), struct.pack("<d", real)))
    number = noise.choice(_INTEGERS) if is_edge else noise.choice((noise.randrange(1000), noise.getrandbits(64)))
    if field.type in _FIXED32:
        return struct.pack("<I", number & 0xFFFF_FFFF)
    if field.type in _FIXED64:
        return struct.pack("<Q", number & (1 << 64) - 1)
    if field.enum_type is not None and noise.random() < 0.7:
        number = noise.choice(field.enum_type.values).number
    return _zigzag(number) if field.type in _ZIGZAG else _varint(number)


def _varint(number: int) -> bytes:
    return varint(number & (1 << 64) - 1)


def _zigzag(number: int) -> bytes:
    return varint((number << 1 ^ number >> 63) & (1 << 64) - 1)
