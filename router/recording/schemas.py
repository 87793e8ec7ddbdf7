"""The envelope of a recording, made of the schemas in it: its payloads can be decoded without `.proto` files."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from router.declared import ONLY_CASE
from router.types.case_by import ByFrame, ByOneof, Wrapping
from router.types.nanopb import NO_OPTIONS
from router.types.protobuf import Envelope, PayloadCase, build_types

_FILE, _NAME, _ONEOF = "rover_router/recorded.proto", "rover_router.Recorded", "payload"


class RecordedCase(NamedTuple):
    """A payload case. `message` is the full name of its type, which `schema`, a FileDescriptorSet, declares.

    `number` is that of the field that holds it; 0 for the only case of an envelope that is itself the payload.
    """

    name: str
    number: int
    message: str
    schema: bytes


def recorded_envelope(cases: Iterable[RecordedCase]) -> Envelope:
    """Return an envelope with these cases. If the protos changed during the recording, the first ones are used."""
    named = {case.number: case for case in sorted(cases, reverse=True)}
    pool, files = DescriptorPool(), dict[str, FileDescriptorProto]()
    for case in named.values():
        for file in FileDescriptorSet.FromString(case.schema).file:
            if files.setdefault(file.name, file) is file:
                pool.AddSerializedFile(file.SerializeToString())
    own = FileDescriptorProto(name=_FILE, package="rover_router", syntax="proto3", dependency=[*files])
    message = own.message_type.add(name="Recorded")
    frame = named.pop(0, None)
    if named:  # protobuf refuses an empty oneof
        message.oneof_decl.add(name=_ONEOF)
    for number, case in named.items():
        kind, label = FieldDescriptorProto.TYPE_MESSAGE, FieldDescriptorProto.LABEL_OPTIONAL
        message.field.add(
            name=case.name, number=number, type=kind, label=label, type_name=f".{case.message}", oneof_index=0
        )
    pool.AddSerializedFile(own.SerializeToString())
    types, _ = build_types(pool, [*files], {}, lambda _: NO_OPTIONS)

    def made(case: RecordedCase, number: int, wrapped: Wrapping | None = None) -> PayloadCase:
        message_class = GetMessageClass(pool.FindMessageTypeByName(case.message))
        return PayloadCase(case.name, number, types[case.message], message_class, None, wrapped)

    if frame is not None:
        only = made(frame, ONLY_CASE, Wrapping(0))
        return Envelope(frame.message, ByFrame(frame.name), only.message_class, {only.name: only}, 0)
    payload_cases = {case.name: made(case, number) for number, case in sorted(named.items())}
    return Envelope(_NAME, ByOneof(_ONEOF), GetMessageClass(pool.FindMessageTypeByName(_NAME)), payload_cases, 0)
