"""Finds the envelope that a table describes: one function for each way in which it says which message a frame holds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from google.protobuf.descriptor import Descriptor, FieldDescriptor

from router.declared import ONLY_CASE
from router.errors import Code, Located, TableError, did_you_mean
from router.types.boards import largest_encoding, largest_fields
from router.types.case_by import ByCases, ByFrame, ByName, Wrapping, named
from router.types.model import MessageType
from router.types.proto_files import ANY
from router.types.protobuf import Envelope, PayloadCase, ProtoSchema, find_envelope, payload_case
from router.types.undecidable import undecidable
from router.types.wire import LEN

ANY_PREFIX = "type.googleapis.com/"
"""What protobuf puts before the full name of a message in its own envelope."""


def chosen_envelope(schema: ProtoSchema, choice: Mapping[str, Sequence[Located[str]]]) -> Envelope:
    """Return the envelope of the schema. `choice` are the keys of the table that say how it holds payloads.

    Raises TableError.
    """
    if "cases" in choice:
        return shared_envelope(schema, choice["cases"])
    names = {key: name for key, (name,) in choice.items()}
    if "oneof" in names:
        return find_envelope(schema, names["oneof"])
    if "payload" in names:
        return named_envelope(schema, names["case"], names["payload"])
    return framed_envelope(schema, names["case"])


def shared_envelope(schema: ProtoSchema, names: Sequence[Located[str]]) -> Envelope:
    """Return an envelope of which each of these fields that is present is a message. Raises TableError."""
    envelope = schema.descriptor(schema.envelope)
    fields = sorted({_case_field(schema, envelope, name) for name in names}, key=_number)
    if refused := list(undecidable([envelope], (), schema.place)):
        raise TableError(refused)
    cases = {field.name: replace(payload_case(schema, field), wrapped=_shared(field)) for field in fields}
    beside = tuple(member for member in schema.messages[envelope.full_name].fields if member.name not in cases)
    return Envelope(
        envelope.full_name,
        schema,
        ByCases([*cases]),
        schema.message_class(envelope.full_name),
        cases,
        largest_fields(envelope.fields, schema.board_options),
        beside=MessageType(envelope.full_name, beside),
    )


def _case_field(schema: ProtoSchema, envelope: Descriptor, name: Located[str]) -> FieldDescriptor:
    field = _field(schema, envelope, name, FieldDescriptor.TYPE_MESSAGE, "message")
    if field.is_required:
        what = f"'{name.value}' of {envelope.full_name} is required, but each message goes on without the others"
        raise TableError.of(name.span, Code.BAD_VALUE, what, f"make it optional: {schema.place(field.full_name)}")
    return field


def _number(field: FieldDescriptor) -> int:
    return field.number


def _shared(field: FieldDescriptor) -> Wrapping:
    return Wrapping(field.number << 3 | LEN, is_shared=True)


def framed_envelope(schema: ProtoSchema, name: Located[str]) -> Envelope:
    """Return an envelope that is itself the payload; `name` is that of its only case. Raises TableError."""
    message = schema.descriptor(schema.envelope)
    if refused := list(undecidable([message], (), schema.place)):
        raise TableError(refused)
    size = largest_encoding(message, schema.board_options)
    made = schema.message_class(schema.envelope)
    case = PayloadCase(name.value, ONLY_CASE, schema.messages[schema.envelope], made, size, Wrapping(0))
    return Envelope(schema.envelope, schema, ByFrame(name.value), made, {case.name: case}, size or 0)


def named_envelope(schema: ProtoSchema, name: Located[str], payload: Located[str]) -> Envelope:
    """Return an envelope with the name of a message in the field `name`, and its bytes in the field `payload`.

    Each message of the compiled files is a case. Raises TableError.
    """
    envelope = schema.descriptor(schema.envelope)
    of_name = _field(schema, envelope, name, FieldDescriptor.TYPE_STRING, "string")
    of_payload = _field(schema, envelope, payload, FieldDescriptor.TYPE_BYTES, "bytes")
    messages = sorted(_messages(schema), key=lambda message: message.full_name.encode())
    if refused := list(undecidable([envelope, *messages], (), schema.place)):
        raise TableError(refused)
    is_optional = not of_payload.has_presence
    prefix = ANY_PREFIX if envelope.full_name == ANY else ""
    cases = {
        message.full_name: PayloadCase(
            message.full_name,
            number,
            schema.messages[message.full_name],
            schema.message_class(message.full_name),
            largest_encoding(message, schema.board_options),
            named(of_name.number, prefix + message.full_name, of_payload.number, is_optional=is_optional),
        )
        for number, message in enumerate(messages, 1)
    }
    beside = [field for field in envelope.fields if field not in (of_name, of_payload)]
    sizes = [case.max_frame for case in cases.values() if case.max_frame is not None]
    names = {field.name for field in beside}
    members = tuple(member for member in schema.messages[envelope.full_name].fields if member.name in names)
    return Envelope(
        envelope.full_name,
        schema,
        ByName(
            (of_name.name, of_name.number),
            (of_payload.name, of_payload.number),
            {prefix + case.name: (case.name, case.number) for case in cases.values()},
        ),
        schema.message_class(envelope.full_name),
        cases,
        max(sizes, default=0) + largest_fields(beside, schema.board_options),
        beside=MessageType(envelope.full_name, members),
        parts=frozenset(cases.keys() & _parts(messages)),
    )


def _field(schema: ProtoSchema, envelope: Descriptor, name: Located[str], kind: int, text: str) -> FieldDescriptor:
    """Return a field of the envelope. Raises TableError if it does not exist, or has another type."""
    field = envelope.fields_by_name.get(name.value)
    fits = [each.name for each in envelope.fields if each.type == kind and not each.is_repeated and not _excludes(each)]
    if field is None:
        what = f"{envelope.full_name} has no field '{name.value}'"
        raise TableError.of(name.span, Code.BAD_VALUE, what, did_you_mean(name.value, fits))
    if field.name not in fits:
        what = f"'{name.value}' of {envelope.full_name} must be a single field of type {text}, not in a oneof"
        raise TableError.of(name.span, Code.BAD_VALUE, what, f"see {schema.place(field.full_name)}")
    return field


def _excludes(field: FieldDescriptor) -> bool:
    """Return whether other fields may clear a field."""
    return field.containing_oneof is not None and len(field.containing_oneof.fields) > 1


def _messages(schema: ProtoSchema) -> Iterator[Descriptor]:
    """Yield the messages that the envelope can hold: those that the files of the folder declare, without itself."""
    for name, message in schema.messages.items():
        is_own = schema.sources.file(name) in schema.files
        if is_own and name != schema.envelope and not message.is_map_entry:
            yield schema.descriptor(name)


def _parts(messages: list[Descriptor]) -> Iterator[str]:
    """Yield the names of messages that other ones contain."""
    for message in messages:
        if message.containing_type is not None:
            yield message.full_name
        inner = (field.message_type for field in message.fields)
        yield from (part.full_name for part in inner if part is not None and part is not message)
