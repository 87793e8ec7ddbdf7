"""The oracle's other half: makes protobuf messages from the results of `reference`, with their constructors.

Uses only values and descriptors. Raises ValueError for what protobuf refuses.
"""

from __future__ import annotations

from typing import Any

from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass

from router.types.descriptors import message_of
from router.types.protobuf import Envelope, PayloadCase, ProtoSchema
from tests.oracles.reference import Value


def envelope_of(schema: ProtoSchema, envelope: Envelope, case: PayloadCase, payload: dict[str, Value]) -> bytes:
    """An envelope with a payload of these fields, serialized by protobuf."""
    made = _message(schema.descriptor(case.type.name), payload)
    return envelope.message_class(**{case.name: made}).SerializeToString()


def _message(descriptor: Descriptor, values: dict[str, Value]) -> Message:
    fields = descriptor.fields_by_name
    return GetMessageClass(descriptor)(**{name: _value(fields[name], value) for name, value in values.items()})


def _value(field: FieldDescriptor, value: Any) -> Any:
    if field.message_type is None:
        return value
    inner = message_of(field)
    if inner.GetOptions().map_entry:
        part = inner.fields_by_name["value"]
        return {entry["key"]: _value(part, entry["value"]) for entry in value}
    return [_message(inner, element) for element in value] if field.is_repeated else _message(inner, value)
