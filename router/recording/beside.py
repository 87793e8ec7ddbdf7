"""Whole datagrams in recordings, with the fields of their envelope beside the payload.

A schema declares these fields, so that viewers show them and `router show` needs no `.proto` files.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

from google.protobuf.descriptor import Descriptor
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from router.recording.channels import DATAGRAM, EVENT, collect
from router.types.framing import restored
from router.types.protobuf import Envelope

_FIELD, _TYPE = "envelope", "Envelope"


class Whole:
    """The messages for whole datagrams of an envelope: a Datagram, or an Event for one that the router has sent.

    If the envelope has fields beside the payload, both have a field `envelope` with these. `label` is then its name in
    a table with several.
    """

    def __init__(self, envelope: Envelope) -> None:
        self.has_beside = bool(envelope.beside.fields)
        self.label = envelope.label if self.has_beside else ""
        self._envelope = envelope

    @cached_property
    def datagram_type(self) -> Descriptor:
        return _with_beside(DATAGRAM, self._envelope) if self.has_beside else DATAGRAM

    @cached_property
    def event_type(self) -> Descriptor:
        return _with_beside(EVENT, self._envelope) if self.has_beside else EVENT

    def datagram(self, frame: bytes, **fields: str | bytes) -> bytes:
        """Return a Datagram with these fields, and those beside the payload of `frame`, b"" if it does not parse."""
        return self._filled(self.datagram_type, frame, fields)

    def event(self, frame: bytes, **fields: str | bytes) -> bytes:
        """Likewise, return an Event."""
        return self._filled(self.event_type, frame, fields)

    def _filled(self, kind: Descriptor, frame: bytes, fields: Mapping[str, str | bytes]) -> bytes:
        message: Any = GetMessageClass(kind)(**fields)
        if self.has_beside and frame:
            message.envelope.MergeFromString(restored(frame))
            message.envelope.DiscardUnknownFields()  # such as the payload
        encoded: bytes = message.SerializePartialToString()
        return encoded


def _with_beside(message: Descriptor, envelope: Envelope) -> Descriptor:
    """Return a message of ours with one more field, for those beside the payload of an envelope."""
    around: Descriptor = envelope.message_class.DESCRIPTOR  # type: ignore[assignment]  # or upb's, which is the same
    names = [field.name for field in envelope.beside.fields]
    members = [around.fields_by_name[name] for name in names]
    types = [kind for member in members if (kind := member.message_type or member.enum_type) is not None]
    files: dict[str, bytes] = {}
    for kind in types:
        collect(kind.file, files)
    own, whole, beside = FileDescriptorProto(), FileDescriptorProto(), DescriptorProto()
    message.file.CopyToProto(own)
    around.file.CopyToProto(whole)
    around.CopyToProto(beside)
    own.dependency.extend(dict.fromkeys(kind.file.name for kind in types))
    take_syntax(own, whole)
    _leave(beside, names)
    own.message_type[0].nested_type.append(beside)
    own.message_type[0].field.add(
        name=_FIELD,
        number=len(message.fields) + 1,
        type=FieldDescriptorProto.TYPE_MESSAGE,
        label=FieldDescriptorProto.LABEL_OPTIONAL,
        type_name=f".{message.full_name}.{_TYPE}",
    )
    pool = DescriptorPool()
    for data in (*files.values(), own.SerializeToString()):
        pool.AddSerializedFile(data)
    return pool.FindMessageTypeByName(message.full_name)


def take_syntax(file: FileDescriptorProto, of: FileDescriptorProto) -> None:
    """Let fields mean the same in `file` as in another one: their presence, defaults and enums."""
    file.ClearField("syntax")  # proto2 has none
    if of.HasField("syntax"):
        file.syntax = of.syntax
    if of.HasField("edition"):
        file.edition = of.edition
        file.options.features.CopyFrom(of.options.features)


def _leave(message: DescriptorProto, names: list[str]) -> None:
    """Leave only these fields of a message, and the oneofs that they are in."""
    fields = [field for field in message.field if field.name in names]
    inside = [field for field in fields if field.HasField("oneof_index")]
    kept = sorted({field.oneof_index for field in inside})
    oneofs = [message.oneof_decl[index] for index in kept]
    for field in inside:
        field.oneof_index = kept.index(field.oneof_index)
    message.CopyFrom(DescriptorProto(name=_TYPE, field=fields, oneof_decl=oneofs, options=message.options))


class Beside(NamedTuple):
    """What a schema of whole datagrams declares: a message with the fields beside the payload, and where it is."""

    message: DescriptorProto
    file: FileDescriptorProto
    imports: Sequence[FileDescriptorProto]


def beside_in(schema: bytes) -> Beside | None:
    """Return what the schema of a Datagram or Event declares; None if no fields are beside the payload."""
    *imports, file = FileDescriptorSet.FromString(schema).file
    nested = file.message_type[0].nested_type
    return Beside(nested[0], file, imports) if nested else None
