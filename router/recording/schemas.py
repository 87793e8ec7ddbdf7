"""The envelope of a recording, made of the schemas in it: its payloads can be decoded without `.proto` files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from typing import NamedTuple

from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
    OneofDescriptorProto,
)
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from router.declared import ONLY_CASE
from router.recording.about import envelopes_of
from router.recording.beside import beside_in, take_syntax
from router.types.case_by import ByCases, ByFrame, ByName, ByOneof, Choice, Wrapping
from router.types.model import MessageType
from router.types.nanopb import NO_OPTIONS
from router.types.protobuf import Envelope, PayloadCase, build_types, no_protos
from router.types.table_envelopes import Envelopes
from router.types.wire import LEN, read_varint

_FILE, _NAME = "rover_router/recorded.proto", "rover_router.Recorded"
_ONEOF, _NAME_FIELD, _DATA_FIELD = "rover_router_payload", "rover_router_name", "rover_router_data"
"""No field beside the payload has such a name."""
_TEXT, _BYTES = FieldDescriptorProto.TYPE_STRING, FieldDescriptorProto.TYPE_BYTES
_OPTIONAL = FieldDescriptorProto.LABEL_OPTIONAL


class RecordedCase(NamedTuple):
    """A payload case, and how its envelope holds it.

    `message` is the full name of its type, which `schema`, a FileDescriptorSet, declares. `envelope` is the name of its
    envelope in a table with several.
    """

    name: str
    around: Wrapping
    message: str
    schema: bytes
    envelope: str = ""


class RecordedTypes(NamedTuple):
    """What the channels of a recording declare: payload cases, and by envelope the schemas of its whole datagrams, if
    these have fields beside the payload.
    """

    cases: Sequence[RecordedCase]
    beside: Mapping[str, bytes]


def wrapping_of(metadata: Mapping[str, str]) -> Wrapping:
    """Return how an envelope holds the payloads of a channel, from its metadata."""
    number = int(metadata["number"])
    before, after = (bytes.fromhex(metadata.get(key, "")) for key in ("before", "after"))
    return Wrapping(number << 3 | LEN if number else 0, before, after, is_shared="shared" in metadata)


def recorded_envelopes(types: RecordedTypes, about: Mapping[str, str]) -> Envelopes:
    """Return the envelopes of a recording, from its types and its metadata."""
    names = envelopes_of(about)
    of_envelope: dict[str, list[RecordedCase]] = {name: [] for known in names for name in known.values()}
    for case in types.cases:
        of_envelope.setdefault(case.envelope, []).append(case)
    by_name = {name: recorded_envelope(several, types.beside.get(name)) for name, several in of_envelope.items()}
    return Envelopes(by_name or {"": recorded_envelope(())}, *names)


def recorded_envelope(cases: Iterable[RecordedCase], beside: bytes | None = None) -> Envelope:
    """Return an envelope with these cases, and with the fields `beside` the payload (see `RecordedTypes`).

    If the protos changed during the recording, the first ones are used.
    """
    known = {(case.around.tag, case.around.before, case.around.after): case for case in sorted(cases, reverse=True)}
    pool, files = DescriptorPool(), dict[str, FileDescriptorProto]()
    around = beside_in(beside) if beside is not None else None
    sets = [FileDescriptorSet.FromString(case.schema).file for case in known.values()]
    for file in chain(*sets, around.imports if around is not None else ()):
        if files.setdefault(file.name, file) is file:
            pool.AddSerializedFile(file.SerializeToString())
    types, _ = build_types(pool, [*files], {}, lambda _: NO_OPTIONS)

    def made(case: RecordedCase, number: int) -> PayloadCase:
        message_class = GetMessageClass(pool.FindMessageTypeByName(case.message))
        kind = types[case.message]
        return PayloadCase(case.name, number, kind, message_class, None, case.around, case.envelope)

    own = FileDescriptorProto(name=_FILE, package="rover_router", syntax="proto3", dependency=[*files])
    message = own.message_type.add()
    if around is not None:
        take_syntax(own, around.file)
        message.CopyFrom(around.message)
    message.name = "Recorded"
    names = {field.name for field in message.field}
    inside = sorted((case for case in known.values() if case.around.is_alone), key=lambda case: case.around.tag)
    named = [case for case in known.values() if case.around.tag and not case.around.is_alone]
    choice: Choice
    if frame := next((case for case in known.values() if not case.around.tag), None):
        only = made(frame, ONLY_CASE)
        return Envelope(frame.message, no_protos(), ByFrame(frame.name), only.message_class, {only.name: only}, 0)
    if named:
        numbered = [(made(case, number), *_name_of(case.around)) for number, case in enumerate(named, 1)]
        payload_cases = [case for case, *_ in numbered]
        fields = (_NAME_FIELD, numbered[0][1]), (_DATA_FIELD, named[0].around.tag >> 3)
        choice = ByName(*fields, {text: (case.name, case.number) for case, _, text in numbered})
        for (name, number), kind in zip(fields, (_TEXT, _BYTES), strict=True):
            message.field.add(name=name, number=number, type=kind, label=_OPTIONAL)
    else:
        payload_cases = [made(case, case.around.tag >> 3) for case in inside]
        choice = _add_fields(message, payload_cases, is_shared=any(case.around.is_shared for case in inside))
    pool.AddSerializedFile(own.SerializeToString())
    by_name = {case.name: case for case in payload_cases}
    message_class = GetMessageClass(pool.FindMessageTypeByName(_NAME))
    label = next((case.envelope for case in payload_cases), "")
    kinds, _ = build_types(pool, [*files, _FILE], {}, lambda _: NO_OPTIONS)
    members = MessageType(_NAME, tuple(field for field in kinds[_NAME].fields if field.name in names))
    return Envelope(_NAME, no_protos(), choice, message_class, by_name, 0, beside=members, label=label)


def _add_fields(message: DescriptorProto, cases: Sequence[PayloadCase], *, is_shared: bool) -> Choice:
    """Add a field for each case: to a oneof, unless a frame may hold several."""
    if cases and not is_shared:  # protobuf refuses an empty oneof
        for field in message.field:
            if field.HasField("oneof_index"):
                field.oneof_index += 1  # a oneof that stands for `optional` must be behind all others
        message.oneof_decl.insert(0, OneofDescriptorProto(name=_ONEOF))
    for each in cases:
        message.field.add(
            name=each.member,
            number=each.number,
            type=FieldDescriptorProto.TYPE_MESSAGE,
            label=_OPTIONAL,
            type_name=f".{each.type.name}",
            oneof_index=None if is_shared else 0,
        )
    return ByCases([each.member for each in cases]) if is_shared else ByOneof(_ONEOF)


def _name_of(around: Wrapping) -> tuple[int, str]:
    """Return the number of the field with the name of a message, and the name."""
    field = around.before or around.after
    tag, position = read_varint(field, 0)
    _, position = read_varint(field, position)
    return tag >> 3, field[position:].decode()
