"""Envelopes to send: golden ones, and generated ones for every payload case with ordinary and extreme values."""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message

from router.datagrams import wire_of_protos
from router.types.wire import delimited, varint
from tests.tables import PROTOS

WIRE = wire_of_protos(PROTOS)
FRAME = 320
"""Bytes of a fixed-size frame: the longest envelope has 305."""

_FLOAT_MAX = 3.4028234663852886e38
_DOUBLE_MAX = 1.7976931348623157e308
_INT32 = (-(2**31), 2**31 - 1)
_LIMITS: dict[int, tuple[Any, ...]] = {
    FieldDescriptor.TYPE_FLOAT: (-_FLOAT_MAX, _FLOAT_MAX, -0.0, 1.401298464324817e-45),
    FieldDescriptor.TYPE_DOUBLE: (-_DOUBLE_MAX, _DOUBLE_MAX, -0.0, 5e-324),
    FieldDescriptor.TYPE_INT32: _INT32,
    FieldDescriptor.TYPE_SINT32: _INT32,
    FieldDescriptor.TYPE_INT64: (-(2**63), 2**63 - 1),
    FieldDescriptor.TYPE_UINT32: (1, 2**32 - 1),
    FieldDescriptor.TYPE_BOOL: (True, True),
    FieldDescriptor.TYPE_ENUM: (*_INT32, 255, 256, -1),
}
_NOT_FINITE = (math.inf, -math.inf, math.nan)
_BITS = {FieldDescriptor.TYPE_FLOAT: (4, "<f"), FieldDescriptor.TYPE_DOUBLE: (8, "<d")}


class Sample(NamedTuple):
    case: str
    datagram: bytes
    payload: Any

    @property
    def variants(self) -> dict[bytes, bool]:
        """The datagram as sent, zero-trimmed, and padded; each with whether the router has to repair it."""
        trimmed, padded = self.datagram.rstrip(b"\0"), self.datagram.ljust(FRAME, b"\0")
        return {self.datagram: False} | {form: form != self.datagram for form in (trimmed, padded)}


def sample(case: str, payload: Message) -> Sample:
    return Sample(case, WIRE.encode(WIRE.envelopes.first.cases[case], payload), payload)


def golden(datagram: bytes) -> Sample:
    decoded = WIRE.decode(datagram)
    return Sample(decoded.case.name, datagram, decoded.message)


def generated(case: str) -> Iterator[Sample]:
    """Samples of one payload case: ordinary values, few fields, and the limits of each field's range."""
    values = [partial(_ordinary, random.Random(f"{case} {seed}")) for seed in range(3)]
    values += [partial(_sparse, random.Random(f"{case} sparse {seed}")) for seed in range(2)]
    values += [partial(_limit, turn) for turn in range(max(map(len, _LIMITS.values())))]
    for value in values:
        payload = WIRE.envelopes.first.cases[case].message_class()
        _fill(payload, value)
        yield sample(case, payload)


def for_boards(case: str) -> Iterator[Sample]:
    """Samples that boards accept: as `generated`, but with declared enum values; and all zeros, in two forms.

    Encoders leave zeros out, but decoders must also accept explicit zeros.
    """
    payload_class = WIRE.envelopes.first.cases[case].message_class
    yield sample(case, payload_class())
    zeros = _zeros(payload_class.DESCRIPTOR)
    yield Sample(case, delimited(WIRE.envelopes.first.cases[case].number, zeros), payload_class.FromString(zeros))
    for made in generated(case):
        _declare(made.payload)
        yield sample(case, made.payload)


def _zeros(message: Any) -> bytes:
    """Every field of the message with this descriptor, encoded as zero."""
    encoded = b""
    for field in message.fields:
        if field.message_type is not None:
            encoded += delimited(field.number, _zeros(field.message_type))
        else:
            size, _ = _BITS.get(field.type, (1, ""))
            encoded += varint(field.number << 3 | {1: 0, 4: 5, 8: 1}[size]) + bytes(size)
    return encoded


def _declare(message: Any) -> None:
    """Replace undeclared enum numbers by the largest declared one."""
    for field, value in message.ListFields():
        if field.message_type is not None:
            _declare(value)
        elif field.enum_type is not None and value not in field.enum_type.values_by_number:
            setattr(message, field.name, max(field.enum_type.values_by_number))


def arbitrary(case: str, seed: int = 0) -> Iterator[Sample]:
    """Endless samples of one payload case: any value of each field, including NaN, infinities and absence."""
    value = partial(_any, random.Random(f"{case} arbitrary {seed}"))
    while True:
        payload = WIRE.envelopes.first.cases[case].message_class()
        _fill(payload, value)
        yield sample(case, payload)


Value = Callable[[FieldDescriptor], Any]
"""The value for a field: a scalar, True for a message that will be filled, or None to leave the field out."""


def _fill(message: Any, value: Value) -> None:
    for field in message.DESCRIPTOR.fields:
        member = value(field)
        if field.message_type is None:
            setattr(message, field.name, field.default_value if member is None else member)
        elif member:
            getattr(message, field.name).SetInParent()
            _fill(getattr(message, field.name), value)


def _any(rng: random.Random, field: FieldDescriptor) -> Any:
    choice = rng.random()
    if choice < 0.1:
        return None
    if field.message_type is not None or choice < 0.5:
        return _ordinary(rng, field)
    if field.type in _BITS:
        size, form = _BITS[field.type]
        return struct.unpack(form, rng.randbytes(size))[0] if choice < 0.9 else rng.choice(_NOT_FINITE)
    return rng.choice(_LIMITS[field.type])


def _limit(turn: int, field: FieldDescriptor) -> Any:
    if field.message_type is not None:
        return True
    limits = _LIMITS[field.type]
    return limits[turn % len(limits)]


def _sparse(rng: random.Random, field: FieldDescriptor) -> Any:
    return _ordinary(rng, field) if rng.random() < 0.4 else None


def _ordinary(rng: random.Random, field: FieldDescriptor) -> Any:
    if field.message_type is not None:
        return True
    if field.enum_type is not None:
        return rng.choice(field.enum_type.values).number
    if field.type in (FieldDescriptor.TYPE_FLOAT, FieldDescriptor.TYPE_DOUBLE):
        return rng.choice((rng.uniform(-180, 180), float(rng.randint(-90, 90))))
    if field.type == FieldDescriptor.TYPE_BOOL:
        return rng.random() < 0.5
    if field.type == FieldDescriptor.TYPE_UINT32:
        return rng.randrange(2 ** rng.randint(1, 32))
    return rng.randrange(-(2 ** rng.randint(1, 31)), 2**31)
