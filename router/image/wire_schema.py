"""The message types of an envelope, and how it says which message it holds, as arrays for `envelope_read`."""

from __future__ import annotations

from collections.abc import Container, Mapping

from google.protobuf.descriptor import Descriptor, FieldDescriptor

from router import declared as c
from router.compiler.lowering.arrays import Arrays
from router.declared import CaseBy, WireFlag, WireKind
from router.types.case_by import ByCases, ByName, ByOneof
from router.types.descriptors import all_fields, all_types, message_of
from router.types.protobuf import Envelope, MessageClass, PayloadCase
from router.types.wire import I32, I64, VARINT, delimited, encoding_of, parses, validates_text


def wire_kind(field: FieldDescriptor) -> WireKind:
    """Return the encoding of a field; of a repeated one, that of a single element."""
    return _BY_TYPE.get(field.type) or _BY_WIRE_TYPE[encoding_of(field).wire_type]


_BY_TYPE: Mapping[int, WireKind] = {
    FieldDescriptor.TYPE_BYTES: WireKind.BYTES,
    FieldDescriptor.TYPE_STRING: WireKind.STRING,
    FieldDescriptor.TYPE_MESSAGE: WireKind.MESSAGE,
    FieldDescriptor.TYPE_GROUP: WireKind.GROUP,
}
_BY_WIRE_TYPE: Mapping[int, WireKind] = {VARINT: WireKind.VARINT, I64: WireKind.I64, I32: WireKind.I32}


def write_schema(envelope: Envelope, routed: Container[str], arrays: Arrays) -> c.WireSchema:
    """Write the types of an envelope and its payloads. `routed` are the cases with a route."""
    choice, roots = envelope.choice, [_descriptor(envelope.message_class)]
    flags: dict[int, int] = {}
    held: list[PayloadCase] = []
    if isinstance(choice, (ByOneof, ByCases)):
        flags = {number: _case_flags(name, routed) for name, number in envelope.numbers.items()}
    elif isinstance(choice, ByName):
        held = [case for case in envelope.cases.values() if case.name in routed]
        roots += [_descriptor(case.message_class) for case in held]
    indexes = all_types(*roots)
    types = []
    for each, index in indexes.items():
        fields = _lowered(each, indexes, {} if index else flags)
        accepts_zero = parses(each, delimited(0, b""))
        types.append(c.WireType(fields=arrays.array(c.WireField, fields), count=len(fields), accepts_zero=accepts_zero))
    by = CaseBy[choice.kind.upper()]
    schema = c.WireSchema(types=arrays.array(c.WireType, types), count=len(types), case_by=by)
    if isinstance(choice, ByName):
        checked = {case.number: indexes[_descriptor(case.message_class)] for case in held}
        names = [_name(text, checked.get(number, 0), arrays) for text, (_, number) in choice.cases.items()]
        schema.names, schema.name_count = arrays.array(c.WireName, names), len(names)
        schema.name_field, schema.payload_field = choice.name[1], choice.data[1]
    return schema


def _descriptor(message_class: MessageClass) -> Descriptor:
    return message_class.DESCRIPTOR  # type: ignore[return-value]  # or upb's, which is the same


def _name(text: str, index: int, arrays: Arrays) -> c.WireName:
    """Write the name of a case; the cases are in the order of their numbers. `index` is that of its type, or 0."""
    data = text.encode()
    return c.WireName(text=arrays.text(data), size=len(data), type=index)


def _case_flags(name: str, routed: Container[str]) -> int:
    return WireFlag.CASE | WireFlag.ROUTED if name in routed else WireFlag.CASE


def _lowered(descriptor: Descriptor, indexes: Mapping[Descriptor, int], flags: Mapping[int, int]) -> list[c.WireField]:
    fields = sorted(all_fields(descriptor), key=lambda field: field.number)
    return [_lowered_field(field, indexes, flags.get(field.number, 0)) for field in fields]


def _lowered_field(field: FieldDescriptor, indexes: Mapping[Descriptor, int], flags: int) -> c.WireField:
    kind = _kind(field)
    if kind in {WireKind.MESSAGE, WireKind.GROUP}:
        return c.WireField(number=field.number, kind=kind, flags=flags, type=indexes[message_of(field)])
    is_packable = field.is_repeated and kind in {WireKind.VARINT, WireKind.I64, WireKind.I32}
    return c.WireField(number=field.number, kind=kind, flags=flags | WireFlag.PACKABLE if is_packable else flags)


def _kind(field: FieldDescriptor) -> WireKind:
    if field.type == FieldDescriptor.TYPE_STRING and not validates_text(field):
        return WireKind.BYTES  # invalid UTF-8 is accepted, as that depends on syntax and features
    return wire_kind(field)
