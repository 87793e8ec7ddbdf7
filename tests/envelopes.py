"""Random envelopes, encoded by hand: every payload case of the rover, and fields unknown to the router."""

from __future__ import annotations

import struct
from functools import cache
from typing import cast

from google.protobuf.descriptor import Descriptor, FieldDescriptor
from hypothesis import strategies as st

from router.errors import Located, SourceSpan
from router.types.protobuf import Envelope, find_envelope, load_protos
from tests.tables import PROTOS

VARINT, I64, LEN, I32 = 0, 1, 2, 5

UNKNOWN_NUMBER = 30
"""Reserved for `uint32 timeout`, which this router does not know."""


@cache
def rover_envelope() -> Envelope:
    here = SourceSpan(__file__)
    return find_envelope(load_protos(Located(PROTOS, here), Located("PBEnvelope", here)), Located("payload", here))


def varint(value: int) -> bytes:
    """The shortest encoding, which every encoder writes."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def tag(number: int, wire_type: int) -> bytes:
    return varint(number << 3 | wire_type)


def framed(number: int, payload: bytes) -> bytes:
    return tag(number, LEN) + varint(len(payload)) + payload


U64 = st.integers(0, 2**64 - 1) | st.sampled_from([0, 1, 127, 128, 256, 1 << 14, 1 << 32])
_FLOATS = st.floats(width=32) | st.sampled_from([0.0, -0.0, 1e-45])


@st.composite
def field(draw: st.DrawFn, numbers: st.SearchStrategy[int]) -> bytes:
    """One field of any wire type except groups."""
    number = draw(numbers)
    kind = draw(st.sampled_from([VARINT, I64, LEN, I32]))
    if kind == VARINT:
        return tag(number, kind) + varint(draw(U64))
    if kind == LEN:
        return framed(number, draw(st.binary(max_size=300)))
    return tag(number, kind) + draw(U64).to_bytes(8, "little")[: 8 if kind == I64 else 4]


unknown_fields = field(st.integers(27, 40) | st.sampled_from([500, 2048, 2**29 - 1]))


@st.composite
def payloads(draw: st.DrawFn, descriptor: Descriptor) -> bytes:
    """An encoded message: any of its fields and unknown ones, in any order, sometimes with explicit zeros."""
    parts = [draw(_value(known)) for known in descriptor.fields if draw(st.booleans())]
    if draw(st.integers(0, 9)) == 0:
        parts.append(draw(unknown_fields))
    return b"".join(draw(st.permutations(parts)))


@st.composite
def _value(draw: st.DrawFn, known: FieldDescriptor) -> bytes:
    if known.message_type is not None:
        return framed(known.number, draw(payloads(known.message_type)))
    if known.type == FieldDescriptor.TYPE_FLOAT:
        return tag(known.number, I32) + struct.pack("<f", draw(_FLOATS))
    if known.type == FieldDescriptor.TYPE_DOUBLE:
        return tag(known.number, I64) + struct.pack("<d", draw(st.floats() | st.just(0.0)))
    if known.type == FieldDescriptor.TYPE_BOOL:
        return tag(known.number, VARINT) + varint(draw(st.integers(0, 1)))
    numbers = st.integers(-5, 300) | st.integers(-(2**31), 2**31 - 1)
    return tag(known.number, VARINT) + varint(draw(numbers) % 2**64)


@st.composite
def envelopes(draw: st.DrawFn) -> bytes:
    """Envelopes, most of them with one payload; some with none, several, one in two pieces, or unknown fields."""
    descriptor = cast("Descriptor", rover_envelope().message_class.DESCRIPTOR)
    cases = st.sampled_from([field.name for field in descriptor.fields])
    chosen = draw(st.sampled_from([0, 1, 1, 1, 1, 2]))
    parts = [draw(_value(descriptor.fields_by_name[draw(cases)])) for _ in range(chosen)]
    parts += draw(st.lists(unknown_fields, max_size=draw(st.sampled_from([0, 0, 1, 3]))))
    return b"".join(draw(st.permutations(parts)))


@st.composite
def damaged(draw: st.DrawFn) -> bytes:
    """An envelope that may be damaged: cut, padded, with flipped bits, a stretched varint or garbage."""
    data = bytearray(draw(envelopes()))
    for _ in range(draw(st.sampled_from([0, 0, 1, 1, 2]))):
        at = draw(st.integers(0, len(data)))
        kind = draw(st.sampled_from(["cut", "pad", "trim", "flip", "insert", "stretch"]))
        if kind == "cut":
            del data[at:]
        elif kind == "pad":
            data += bytes(at + 1)
        elif kind == "trim":
            data = data.rstrip(b"\0")
        elif kind == "insert":
            data[at:at] = draw(st.binary(max_size=8))
        elif at < len(data):
            if kind == "flip":
                data[at] ^= 1 << draw(st.integers(0, 7))
            elif data[at] < 0x80:
                data[at : at + 1] = bytes((data[at] | 0x80, 0))
    return bytes(data)
