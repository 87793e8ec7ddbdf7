"""The protobuf side of the type model: a folder of `.proto` files, compiled at start-up, and the envelope in it.

Knows nothing of routes; the names it is asked for come from the table's `envelope:`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.descriptor_pb2 import DescriptorProto, EnumDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.empty_pb2 import Empty
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass

from router.errors import Code, Diagnostic, SourceSpan, TableError, did_you_mean, shown_path
from router.table.model import EnvelopeSettings
from router.types.board_options import NO_OPTIONS, BoardOptions, OptionsFile, read_options
from router.types.descriptors import container, message_of
from router.types.lock_file import read_lock
from router.types.model import Enum, MessageType
from router.types.proto_folder import OPTIONS, PROTO, read_folder, sha256_of
from router.types.proto_model import build_types
from router.types.proto_source import Part, ProtoSources
from router.types.protoc import WELL_KNOWN, compile_protos
from router.types.sizes import framed_size, largest_beside, largest_encoding

MessageClass = type[Message]


class ProtoSchema:
    """Everything that the `.proto` files below `root` declare, by full name.

    What they import of `google/protobuf` is among them. `sha256` is over the relative names and the bytes
    of all `.proto` and `.options` files; `files` has those names.
    """

    def __init__(
        self,
        root: Path,
        files: Mapping[str, bytes],
        compiled: FileDescriptorSet,
        sources: ProtoSources,
        options: Mapping[str, OptionsFile],
    ) -> None:
        self.root = root
        self.files = tuple(files)
        self.sha256 = sha256_of(files)
        self.sources = sources
        self._options = options
        self._pool = DescriptorPool()
        for file in compiled.file:
            self._pool.AddSerializedFile(file.SerializeToString())
        self.messages: Mapping[str, MessageType]
        self.enums: Mapping[str, Enum]
        names = [file.name for file in compiled.file]
        self.messages, self.enums = build_types(self._pool, names, sources, self.board_options)

    def message_class(self, name: str) -> MessageClass:
        """The Python class of a message, by full name. Raises KeyError."""
        return GetMessageClass(self.descriptor(name))

    def descriptor(self, name: str) -> Descriptor:
        """By full name. Raises KeyError."""
        return self._pool.FindMessageTypeByName(name)

    def reserved_numbers(self, name: str) -> list[range]:
        """What a message or an enum, by full name, says to be `reserved`."""
        if name in self.enums:
            declared = EnumDescriptorProto()
            self._pool.FindEnumTypeByName(name).CopyToProto(declared)
            return [range(span.start, span.end + 1) for span in declared.reserved_range]
        message = DescriptorProto()
        self.descriptor(name).CopyToProto(message)
        return [range(span.start, span.end) for span in message.reserved_range]

    def board_options(self, field: FieldDescriptor) -> BoardOptions:
        """What the `.options` file beside the field's `.proto` says about it."""
        options = self._options.get(container(field).file.name)
        return options.of(container(field).full_name, field.name) if options is not None else NO_OPTIONS

    def span(self, message: str, field: str | None = None) -> SourceSpan:
        """The place of a declaration in its `.proto` file: of a message or enum, of a field or enum value."""
        return self.sources.span(message if field is None else f"{message}.{field}", Part.NAME)


@dataclass(frozen=True, slots=True)
class PayloadCase:
    """One member of the envelope's oneof.

    `max_size` is the largest encoding of the payload in bytes as nanopb computes it, None when unbounded.
    """

    name: str
    number: int
    type: MessageType
    message_class: MessageClass
    max_size: int | None


@dataclass(frozen=True, slots=True)
class Envelope:
    """The message around every payload, by full name.

    `max_size` is its largest encoding in bytes over the cases that have one, nanopb's `PBEnvelope_size`.
    """

    name: str
    oneof: str
    message_class: MessageClass
    cases: Mapping[str, PayloadCase]
    max_size: int


def load_protos(root: Path, blame: SourceSpan | None = None) -> ProtoSchema:
    """Compile all `.proto` files below `root`.

    Raises TableError with every finding. What is wrong with the folder itself is blamed on `blame`, the
    place that names it, else on the folder.
    """
    root = root.resolve()
    files = read_folder(root, blame or SourceSpan(shown_path(root)))
    homes = _homes(root)
    compiled = compile_protos(root, [name for name in files if name.endswith(PROTO)], homes)
    paths = {file.name: (root if file.name in files else WELL_KNOWN) / file.name for file in compiled.file}
    sources = ProtoSources(compiled.file, paths)
    findings = _same_name_findings([file for file in compiled.file if file.name in files], sources, homes)
    options = {}
    for name in files:
        if name.endswith(OPTIONS):
            options[name[: -len(OPTIONS)] + PROTO], complaints = read_options(root / name)
            findings += complaints
    if findings:
        raise TableError(findings)
    return ProtoSchema(root, files, compiled, sources, options)


def without_protos() -> tuple[ProtoSchema, Envelope]:
    """What a table refers to that has no envelope: no declarations, and an envelope without payload cases."""
    schema = ProtoSchema(Path(), {}, FileDescriptorSet(), ProtoSources((), {}), {})
    return schema, Envelope("", "", Empty, {}, 0)


def _homes(root: Path) -> Mapping[str, str]:
    """The files that the lock knows messages to belong to; what is wrong with the lock is `lock`'s finding."""
    try:
        lock = read_lock(root)
    except TableError:
        return {}
    return {name: message.file for name, message in lock.messages.items()} if lock is not None else {}


def _same_name_findings(
    files: Sequence[FileDescriptorProto], sources: ProtoSources, homes: Mapping[str, str]
) -> list[Diagnostic]:
    """Messages of two packages under one short name: ROS interfaces and the table only have short names."""
    names: dict[str, list[str]] = {}
    for file in files:
        for message in file.message_type:
            full = f"{file.package}.{message.name}" if file.package else message.name
            names.setdefault(message.name, []).append(full)
    findings = []
    for short, same in names.items():
        first, *others = sorted(same, key=lambda name: name not in homes)
        place = sources.span(first)
        hint = f"the other is at {place.file}:{place.line}; names must differ even in different packages"
        text = f"there are two messages '{short}'"
        findings += [Diagnostic(sources.span(name), Code.DUPLICATE_MESSAGE, text, hint) for name in others]
    return findings


def find_envelope(schema: ProtoSchema, settings: EnvelopeSettings) -> Envelope:
    """The message and the oneof that the table names, the message by full or short name.

    Raises TableError: a name that does not exist, a member of the oneof that is no message.
    """
    wanted = settings.message
    named = [name for name in schema.messages if wanted.value in (name, name.rpartition(".")[2])]
    name = wanted.value if wanted.value in named else next(iter(named), None)
    if name is None:
        hint = did_you_mean(wanted.value, schema.messages)
        message = f"no .proto file declares a message '{wanted.value}'"
        raise TableError([Diagnostic(wanted.span, Code.BAD_VALUE, message, hint)])
    descriptor = schema.descriptor(name)
    oneof = descriptor.oneofs_by_name.get(settings.oneof.value)
    if oneof is None:
        hint = did_you_mean(settings.oneof.value, descriptor.oneofs_by_name)
        message = f"{name} has no oneof '{settings.oneof.value}'"
        raise TableError([Diagnostic(settings.oneof.span, Code.BAD_VALUE, message, hint)])
    if scalars := [field for field in oneof.fields if field.message_type is None]:
        raise TableError([_scalar_finding(schema, field) for field in scalars])
    cases = {field.name: _payload_case(schema, field) for field in oneof.fields}
    # A case without a bound is reported where a board shall take it.
    bounded = [framed_size(case.number, case.max_size) for case in cases.values() if case.max_size is not None]
    max_size = max(bounded, default=0) + largest_beside(oneof, schema.board_options)
    return Envelope(name, oneof.name, schema.message_class(name), cases, max_size)


def _scalar_finding(schema: ProtoSchema, field: FieldDescriptor) -> Diagnostic:
    span = schema.span(container(field).full_name, field.name)
    message = f"'{field.name}' is a payload case and must be a message"
    return Diagnostic(span, Code.BAD_PROTO, message, "wrap the value in a message of its own")


def _payload_case(schema: ProtoSchema, field: FieldDescriptor) -> PayloadCase:
    message = message_of(field)
    size = largest_encoding(message, schema.board_options)
    return PayloadCase(field.name, field.number, schema.messages[message.full_name], GetMessageClass(message), size)
