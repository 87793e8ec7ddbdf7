"""An envelope's message types as the arrays that `envelope_read` parses by."""

from __future__ import annotations

import ctypes
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum, IntFlag

from google.protobuf.descriptor import Descriptor, FieldDescriptor

from router.carrier.structures import Schema, WireField, WireType
from router.types.descriptors import message_of
from router.types.protobuf import Envelope
from router.types.undecidable import all_fields, all_types
from router.types.wire import I32, I64, VARINT, delimited, parses, validates_text, wire_type_of


class WireKind(IntEnum):
    """`enum wire_kind` in envelope.h."""

    VARINT = 0
    I64 = 1
    I32 = 2
    BYTES = 3
    STRING = 4
    MESSAGE = 5
    GROUP = 6


class WireFlag(IntFlag):
    """`enum wire_flag` in envelope.h."""

    PACKABLE = 1
    CASE = 2
    ROUTED = 4


@dataclass(frozen=True, slots=True)
class WireSchema:
    """A `struct wire_schema`, and the arrays that it points to. C may use it as long as this object lives."""

    schema: Schema
    types: ctypes.Array[WireType]
    fields: Sequence[ctypes.Array[WireField]]

    @property
    def address(self) -> int:
        return ctypes.addressof(self.schema)


def wire_kind(field: FieldDescriptor) -> WireKind:
    """How a field is encoded, of a repeated one an element by itself."""
    return _BY_TYPE.get(field.type) or _BY_WIRE_TYPE[wire_type_of(field)]


_BY_TYPE: Mapping[int, WireKind] = {
    FieldDescriptor.TYPE_BYTES: WireKind.BYTES,
    FieldDescriptor.TYPE_STRING: WireKind.STRING,
    FieldDescriptor.TYPE_MESSAGE: WireKind.MESSAGE,
    FieldDescriptor.TYPE_GROUP: WireKind.GROUP,
}
_BY_WIRE_TYPE: Mapping[int, WireKind] = {VARINT: WireKind.VARINT, I64: WireKind.I64, I32: WireKind.I32}


def wire_schema(envelope: Envelope, routed: Container[int]) -> WireSchema:
    """Return the types of an envelope and its payloads. `routed` are the numbers of the cases that have a route."""
    descriptor: Descriptor = envelope.message_class.DESCRIPTOR  # type: ignore[assignment]  # or upb's, which is the same
    flags = {case.number: _case_flags(case.number, routed) for case in envelope.cases.values()}
    indexes = all_types(descriptor)
    arrays = [_lowered(each, indexes, {} if index else flags) for each, index in indexes.items()]
    types = (WireType * len(arrays))(
        *(
            WireType(fields, len(fields), parses(each, delimited(0, b"")))
            for fields, each in zip(arrays, indexes, strict=True)
        )
    )
    return WireSchema(Schema(types, len(types)), types, arrays)


def _case_flags(number: int, routed: Container[int]) -> WireFlag:
    return WireFlag.CASE | WireFlag.ROUTED if number in routed else WireFlag.CASE


def _lowered(
    descriptor: Descriptor, indexes: Mapping[Descriptor, int], flags: Mapping[int, WireFlag]
) -> ctypes.Array[WireField]:
    fields = sorted(all_fields(descriptor), key=lambda field: field.number)
    lowered = [_lowered_field(field, indexes, flags.get(field.number, WireFlag(0))) for field in fields]
    return (WireField * len(lowered))(*lowered)


def _lowered_field(field: FieldDescriptor, indexes: Mapping[Descriptor, int], flags: WireFlag) -> WireField:
    kind = _kind(field)
    if kind in {WireKind.MESSAGE, WireKind.GROUP}:
        return WireField(field.number, kind, flags, indexes[message_of(field)])
    is_packable = field.is_repeated and kind in {WireKind.VARINT, WireKind.I64, WireKind.I32}
    return WireField(field.number, kind, WireFlag.PACKABLE if is_packable else WireFlag(0), 0)


def _kind(field: FieldDescriptor) -> WireKind:
    if field.type == FieldDescriptor.TYPE_STRING and not validates_text(field):
        return WireKind.BYTES  # what is no UTF-8 is accepted; that depends on syntax and features
    return wire_kind(field)
