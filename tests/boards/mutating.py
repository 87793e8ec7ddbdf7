"""Envelopes that are almost right: valid ones with fields added, repeated, split and damaged, cut and padded."""

from __future__ import annotations

import math
import random
import struct
from typing import Any

from google.protobuf.descriptor import FieldDescriptor

from router.datagrams import Wire
from router.types.wire import delimited, varint

_NUMBERS = (0, 1, 127, 128, 16384, 2**31 - 1)
_FLOATS = (0.0, -0.0, 1.0, -1.5, 100.0, 1e-45)


class Mutator:
    """Random envelopes; the same seed gives the same ones."""

    def __init__(self, wire: Wire, seed: int) -> None:
        self._cases = list(wire.envelopes.first.cases.values())
        self._rng = random.Random(seed)

    def envelope(self) -> bytes:
        rng, case = self._rng, self._rng.choice(self._cases)
        payload = self._payload(case)
        match rng.randrange(8):
            case 0:
                payload += self._field()
            case 1:
                payload += self._payload(case)  # merged into the first one
            case 2:
                payload = self._damaged(payload)
        made = self._delimited(case.number, payload)
        match rng.randrange(10):
            case 0:
                made += self._field()
            case 1:
                made = self._field() + made
            case 2:
                made += delimited(case.number, self._payload(case))
            case 3:
                other = rng.choice(self._cases)
                made += delimited(other.number, self._payload(other))
            case 4:
                made = self._damaged(made)
        return rng.choice((made, made, made.rstrip(b"\0"), made.ljust(400, b"\0")))

    def _payload(self, case: Any) -> bytes:
        message = case.message_class()
        self._fill(message)
        return bytes(message.SerializeToString())

    def _fill(self, message: Any) -> None:
        """Some of the fields, with values and lengths below and above the limits of boards."""
        for field in message.DESCRIPTOR.fields:
            if self._rng.random() < 0.4:
                continue
            many = self._rng.randrange(5) if field.is_repeated else 1
            member = getattr(message, field.name)
            if field.message_type is not None and field.message_type.GetOptions().map_entry:
                for number in range(many):
                    member[number] = self._value(field.message_type.fields_by_name["value"])
            elif field.message_type is None:
                values = [self._value(field) for _ in range(many)]
                member.extend(values) if field.is_repeated else setattr(message, field.name, values[0])
            elif field.is_repeated:
                for _ in range(many):
                    self._fill(member.add())
            else:
                member.SetInParent()
                self._fill(member)

    def _value(self, field: FieldDescriptor) -> Any:
        if field.type in (FieldDescriptor.TYPE_FLOAT, FieldDescriptor.TYPE_DOUBLE):
            return self._rng.choice(_FLOATS if self._rng.random() < 0.95 else (math.nan, math.inf, -math.inf))
        if field.type == FieldDescriptor.TYPE_BOOL:
            return self._rng.random() < 0.5
        if field.enum_type is not None:
            return self._rng.choice(field.enum_type.values).number
        if field.type in (FieldDescriptor.TYPE_STRING, FieldDescriptor.TYPE_BYTES):
            text = "x" * self._rng.randrange(9)
            return text if field.type == FieldDescriptor.TYPE_STRING else text.encode()
        return self._rng.choice(_NUMBERS)

    def _field(self) -> bytes:
        """A known or unknown field, with a wire type that may be wrong."""
        number = self._rng.choice((*range(1, 12), 30, 999))
        match self._rng.randrange(5):
            case 0:
                return varint(number << 3) + varint(self._rng.choice((0, 1, 2**32 - 1, 2**64 - 1)))
            case 1:
                return varint(number << 3 | 1) + self._rng.randbytes(8)
            case 2:
                return varint(number << 3 | 5) + struct.pack("<f", self._rng.choice(_FLOATS))
            case 3:
                return varint(number << 3 | 3) + varint(number << 3 | 4)
        return self._delimited(number, self._rng.choice((b"", bytes(3), self._rng.randbytes(5), bytes(180))))

    def _delimited(self, number: int, value: bytes) -> bytes:
        """A length-delimited value whose size may be encoded with redundant bytes."""
        size = varint(len(value))
        if self._rng.random() < 0.2:
            size = size[:-1] + bytes([size[-1] | 0x80]) + self._rng.choice((b"\0", b"\x80\0", b"\x80\x80\0"))
        return varint(number << 3 | 2) + size + value

    def _damaged(self, data: bytes) -> bytes:
        at = self._rng.randrange(len(data) + 1)
        bit = bytes([data[at] ^ 1 << self._rng.randrange(8)]) if at < len(data) else b""
        return self._rng.choice((data[:at], data[:at] + bit + data[at + 1 :], data[:at] + b"\x80" + data[at:]))
