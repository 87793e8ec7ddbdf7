"""The protobuf side of the type model: the envelope and its imports, compiled at start-up.

Other files in the folder are only checked, and problems in them are warnings. A map becomes a list of its entry
messages, a group becomes a message; extensions are omitted.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from google.protobuf.descriptor import Descriptor, EnumDescriptor, FieldDescriptor
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    EnumDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.empty_pb2 import Empty
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass

from router import inputs
from router.errors import Code, Diagnostic, Located, SourceSpan, TableError, did_you_mean, nearest, plural, shown_path
from router.types.boards import (
    largest_beside,
    largest_encoding,
    longest,
    member_size,
    unbounded_fields,
)
from router.types.case_by import ByOneof, Choice, Wrapping
from router.types.descriptors import declared_type, enum_of, message_of, same_type
from router.types.lock_file import LOCK_NAME, Lock, read_lock
from router.types.model import Bytes, Enum, Field, List, MessageType, String, Type
from router.types.nanopb import NO_OPTIONS, BoardOptions, NanopbOptions, OptionsFile, declares_options, read_options
from router.types.proto_files import OPTIONS, Folder, envelope_file, proto_of, reached, read_folder
from router.types.proto_source import Part, ProtoSources, field_comments, holders, inside
from router.types.protoc import check_protos, compile_protos, findings_of, shipped
from router.types.undecidable import undecidable
from router.types.wire import LEN, encoding_of, validates_text

MessageClass = type[Message]


class ProtoSchema:
    """Everything that the compiled `.proto` files below `root` declare, by full name.

    This includes their imports from `google/protobuf`. `sha256` covers the relative names and the bytes of all `.proto`
    and `.options` files of the folder; `files` has the names of the compiled ones. `envelope` is the full name of the
    envelope, `lock` the path of the lock file, `exclude` the excluded files, `warnings` the problems of other files and
    of `.options` files. `inputs` is everything that was read.
    """

    def __init__(
        self,
        folder: Folder,
        envelope: str,
        lock: Path,
        compiled: FileDescriptorSet,
        options: Mapping[str, OptionsFile],
        warnings: Sequence[Diagnostic],
    ) -> None:
        self.root = folder.root
        self.envelope = envelope
        self.lock = lock
        self.exclude: Sequence[str] = ()
        self.with_others = False
        self.inputs = inputs.Inputs()
        own = [file for file in compiled.file if inputs.is_file(folder.root / file.name)]
        self.files = tuple(file.name for file in own if not declares_options(file))
        self.sha256 = folder.sha256
        self.sources = _sources(folder, compiled)
        self.warnings = tuple(warnings)
        has_options = bool(options) or any(map(declares_options, compiled.file))
        self._options = NanopbOptions(options) if has_options else None
        self._pool = DescriptorPool()
        for file in compiled.file:
            self._pool.AddSerializedFile(file.SerializeToString())
        self.messages: Mapping[str, MessageType]
        self.enums: Mapping[str, Enum]
        names = [file.name for file in compiled.file]
        self.messages, self.enums = build_types(self._pool, names, field_comments(compiled.file), self.board_options)

    def message_class(self, name: str) -> MessageClass:
        """Return the Python class of a message, by full name. Raises KeyError."""
        return GetMessageClass(self.descriptor(name))

    def descriptor(self, name: str) -> Descriptor:
        """Return the descriptor of a message, by full name. Raises KeyError."""
        return self._pool.FindMessageTypeByName(name)

    def reserved_numbers(self, name: str) -> list[range]:
        """Return the `reserved` numbers of a message or an enum, by full name."""
        if name in self.enums:
            declared = EnumDescriptorProto()
            self._pool.FindEnumTypeByName(name).CopyToProto(declared)
            return [range(span.start, span.end + 1) for span in declared.reserved_range]
        message = DescriptorProto()
        self.descriptor(name).CopyToProto(message)
        return [range(span.start, span.end) for span in message.reserved_range]

    def board_options(self, field: FieldDescriptor) -> BoardOptions:
        """Return nanopb's options of a field, from its `.proto` file and the `.options` file beside it."""
        return self._options.of(field) if self._options is not None else NO_OPTIONS

    def unbounded(self, message: str) -> str:
        """Describe the first field of a message, by full name, without a largest encoding, and count others; or ""."""
        fields = [*unbounded_fields(self.descriptor(message), self.board_options)]
        if not fields:
            return ""
        path = ".".join(step.name for step in fields[0].path)
        more = f" (and {plural(len(fields) - 1, 'more field')})" if len(fields) > 1 else ""
        return f"{path} {fields[0].why}{more}"

    def span(self, message: str, field: str | None = None) -> SourceSpan:
        """Return the span of a message or enum, or of a field or enum value, in its `.proto` file."""
        return self.sources.span(message if field is None else f"{message}.{field}", Part.NAME)

    def place(self, name: str) -> SourceSpan:
        """Return the span of a declaration by full name; of one outside these files, the envelope's."""
        try:
            return self.sources.span(name, Part.NAME)
        except LookupError:
            return self.span(self.envelope)


@dataclass(frozen=True, slots=True)
class PayloadCase:
    """One of the messages that an envelope can hold. `number` is unique among them: that of its field, if it has one.

    `max_size` is the largest encoding of the payload in bytes as nanopb computes it, None when unbounded. `wrapped`
    says how the envelope holds it, None for a field with its number. `envelope` is the label of the envelope, which
    also begins `name` if another one has a case of that name.
    """

    name: str
    number: int
    type: MessageType
    message_class: MessageClass
    max_size: int | None
    wrapped: Wrapping | None = None
    envelope: str = ""

    @property
    def descriptor(self) -> Descriptor:
        return self.message_class.DESCRIPTOR  # type: ignore[return-value]  # of upb

    @property
    def member(self) -> str:
        """The field of the envelope, of a case that is one."""
        return self.name.rpartition(".")[2]

    @property
    def wrapping(self) -> Wrapping:
        return self.wrapped if self.wrapped is not None else Wrapping(self.number << 3 | LEN)

    @property
    def max_frame(self) -> int | None:
        """The largest encoding in bytes of an envelope with only this payload, None when unbounded."""
        return self.wrapping.size(self.max_size) if self.max_size is not None else None


@dataclass(frozen=True, slots=True)
class Unroutable:
    """A member of the envelope's oneof that is no message; `type` as in `.proto` files."""

    number: int
    type: str
    wire_type: int


@dataclass(frozen=True, eq=False)
class Envelope:
    """The message around payloads, by full name. `beside` has only its fields beside the payload.

    `max_size` is its largest encoding in bytes, nanopb's `PBEnvelope_size`; unbounded cases do not count. `choice` says
    which of the `cases` a frame holds; `unroutable` are those that no route can take, `parts` those that are also parts
    of other messages, and therefore need no route. `schema` declares its types; that of a recording is empty. Compared
    by identity.
    """

    name: str
    schema: ProtoSchema
    choice: Choice
    message_class: MessageClass
    cases: Mapping[str, PayloadCase]
    max_size: int
    unroutable: Mapping[str, Unroutable] = field(default_factory=dict)
    beside: MessageType = field(default_factory=lambda: MessageType(""))
    parts: frozenset[str] = frozenset()
    label: str = ""
    """Its name in a table with several."""

    @property
    def numbers(self) -> Mapping[str, int]:
        """The numbers of all cases, also of those that no route can take."""
        numbers = {name: case.number for name, case in self.cases.items()}
        return numbers | {name: member.number for name, member in self.unroutable.items()}

    @cached_property
    def _names(self) -> Mapping[int, str]:
        return {number: name for name, number in self.numbers.items()}

    def cases_in(self, datagram: bytes) -> Sequence[str]:
        """Return the cases that a datagram seems to hold: it is not parsed (`Choice.numbers_in`)."""
        return [self._names[number] for number in self.choice.numbers_in(datagram, self._names)]

    def members_of(self, frame: Message) -> Sequence[str]:
        """Return the names of the cases that a parsed frame holds, even of those that no route can take."""
        names = self.choice.members_of(frame) if self.numbers else ()
        return [name if name in self.numbers else f"{self.label}.{name}" for name in names]

    def holding(self, case: PayloadCase) -> Sequence[PayloadCase]:
        """Return the cases with the type of a case of another envelope; if one of several has its name, only that."""
        found = [each for each in self.cases.values() if same_type(each.descriptor, case.descriptor)]
        return [each for each in found if each.member == case.member and len(found) > 1] or found

    def payloads_of(self, frame: Message) -> list[tuple[PayloadCase, Message]]:
        """Return the payloads of a parsed frame that a route can take, with their cases.

        Raises protobuf's DecodeError.
        """
        cases = (self.cases[name] for name in self.members_of(frame) if name in self.cases)
        return [(case, self.choice.payload(frame, case)) for case in cases]

    def beside_of(self, frame: Message) -> Message:
        """Return a copy of a parsed frame with only its fields beside the payload."""
        beside = self.message_class()
        if self.beside.fields:
            beside.CopyFrom(frame)
            beside.DiscardUnknownFields()
            for field, _ in frame.ListFields():
                if self.beside.field(field.name) is None:
                    beside.ClearField(field.name)
        return beside

    def around(self, case: PayloadCase, payload: Message, beside: Message | None = None) -> Message:
        """Return an envelope with this payload, even an empty one, and with the other fields of `beside`."""
        envelope = self.message_class()
        if beside is not None:
            envelope.CopyFrom(beside)
        self.choice.put(envelope, case, payload)
        return envelope


def load_protos(
    protos: Located[Path],
    message: Located[str],
    lock: Located[Path] | None = None,
    exclude: Sequence[Located[str]] = (),
    *,
    with_others: bool = False,
) -> ProtoSchema:
    """Compile the file below `protos` that declares the envelope `message`, and what it imports.

    Other files of the folder, except those in `exclude`, are only checked; `with_others`, they are also compiled if
    they have no errors. Raises TableError with all findings. Findings about the folder itself point at its name.
    """
    with inputs.noted() as read:
        schema = _load(protos, message, lock, exclude, with_others=with_others)
    schema.exclude = [entry.value for entry in exclude]
    schema.with_others = with_others
    schema.inputs = read
    return schema


def _load(
    protos: Located[Path],
    message: Located[str],
    lock: Located[Path] | None,
    exclude: Sequence[Located[str]],
    *,
    with_others: bool,
) -> ProtoSchema:
    root = Path(inputs.real_path(protos.value))
    folder = read_folder(root, protos.span, exclude)
    path = lock_path(protos, lock)
    locked = _readable_lock(path)
    file, envelope = envelope_file(folder, protos, message, locked)
    used = reached(file, folder.files) if folder.faults or folder.excluded else {file}
    if faults := [finding for name in sorted(used) for finding in _faults(folder, name)]:
        raise TableError(faults)
    if needed := [_excluded_finding(name, message, folder) for name in sorted(used & folder.excluded.keys())]:
        raise TableError(needed)
    compiled = compile_protos(folder, [file])
    names = [file.name for file in compiled.file]
    warnings, valid = _check_others(folder, names)
    if with_others and valid:
        compiled = compile_protos(folder, [*names, *valid])
    return _schema(folder, envelope, path, compiled, warnings)


def _schema(
    folder: Folder, envelope: str, lock: Path, compiled: FileDescriptorSet, warnings: Sequence[Diagnostic]
) -> ProtoSchema:
    """Return the declarations, with the options of boards. Raises TableError."""
    files = {file.name: file for file in compiled.file}
    _note_hidden(folder, files)
    findings = _reserved_number_findings(folder, compiled)
    warnings = list(warnings)
    options = {}
    for name in folder.files:
        if name.endswith(OPTIONS):
            proto = proto_of(name)
            options[proto], complaints = read_options(folder.root / name)
            if proto in files:
                findings += complaints
                warnings += options[proto].unused(files[proto])
            elif complaints:
                warnings.append(_unused(proto, complaints))
    if findings:
        raise TableError(findings)
    return ProtoSchema(folder, envelope, lock, compiled, options, warnings)


def load_folder(protos: Located[Path]) -> ProtoSchema:
    """Compile all valid `.proto` files below `protos`, without an envelope. Raises TableError if there is none."""
    folder = read_folder(Path(inputs.real_path(protos.value)), protos.span)
    warnings, valid = _check_others(folder, [])
    if not valid:
        raise TableError(warnings)
    return _schema(folder, "", lock_path(protos, None), compile_protos(folder, valid), warnings)


def _note_hidden(folder: Folder, compiled: Collection[str]) -> None:
    """Read the files that only protoc has read, because others import them, so that they are recorded as inputs."""
    for name in compiled:
        if name not in folder.files and inputs.is_file(folder.root / name):
            inputs.read_bytes(folder.root / name)


def no_protos() -> ProtoSchema:
    """Return empty declarations."""
    return ProtoSchema(Folder(Path(), {}, {}), "", Path(), FileDescriptorSet(), {}, [])


def no_envelope() -> Envelope:
    """Return an envelope without payload cases, for a table without an envelope."""
    return Envelope("", no_protos(), ByOneof(""), Empty, {}, 0)


def lock_path(protos: Located[Path], lock: Located[Path] | None) -> Path:
    """Return the path of the lock file: `lock`, by default beside the protos."""
    return Path(inputs.real_path(lock.value if lock is not None else protos.value / LOCK_NAME))


def _readable_lock(path: Path) -> Lock | None:
    """Read the lock, if possible. `LockComparison` reports its problems."""
    try:
        return read_lock(path)
    except TableError:
        return None


def _faults(folder: Folder, proto: str) -> list[Diagnostic]:
    return [fault for name, faults in folder.faults.items() if proto_of(name) == proto for fault in faults]


def _check_others(folder: Folder, compiled: Sequence[str]) -> tuple[list[Diagnostic], list[str]]:
    """Check the files that were not compiled. Return warnings about faulty ones, and the names of valid ones."""
    unused = [(name, faults) for name, faults in folder.faults.items() if proto_of(name) not in compiled]
    warnings = [_unused(proto_of(name), faults) for name, faults in unused]
    valid = [name for name in folder.protos if name not in compiled and name not in folder.faults]
    if folder.excluded:  # files that need an excluded file are also left out
        valid = [name for name in valid if folder.excluded.keys().isdisjoint(reached(name, folder.files))]
    if not valid:
        return warnings, []
    complaints = check_protos(folder, compiled, valid)
    news = [complaint for complaint in complaints if complaint.file not in folder.faults]
    files: dict[str, list[Diagnostic]] = {}
    for finding in findings_of(news, folder):
        files.setdefault(finding.span.file, []).append(finding)
    names = {shown_path(folder.root / name): name for name in valid}
    warnings += [_unused(names.get(file, ""), findings) for file, findings in files.items()]
    broken = {complaint.file for complaint in complaints}
    return warnings, [name for name in valid if name not in broken]


def _unused(proto: str, faults: Sequence[Diagnostic]) -> Diagnostic:
    """Return the first fault of a file that is not compiled. `proto` is "" for a file that is only imported."""
    first = faults[0]
    more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
    message = f"the envelope does not use this file, so it is left out: {first.message}{more}"
    hint = first.hint
    if proto:
        hint = f"{hint or 'repair it'}; or, if it is not yours, write `exclude: [{proto}]` in the table's `envelope`"
    return replace(first, code=Code.UNUSED_PROTO, message=message, hint=hint)


def _excluded_finding(name: str, envelope: Located[str], folder: Folder) -> Diagnostic:
    """Return the finding for a file in `exclude` that the envelope imports."""
    by = folder.excluded[name]
    what = f"'{by.value}' cannot be excluded: the envelope {envelope.value} needs {name}"
    return Diagnostic(by.span, Code.BAD_VALUE, what, "exclude only what the envelope does not import")


def _sources(folder: Folder, compiled: FileDescriptorSet) -> ProtoSources:
    names = [file.name for file in compiled.file]
    paths = {name: path if inputs.is_file(path := folder.root / name) else shipped(name) for name in names}
    return ProtoSources(compiled.file, paths)


def _reserved_number_findings(folder: Folder, compiled: FileDescriptorSet) -> list[Diagnostic]:
    """Return findings for field numbers that protoc refuses, but only in the files that its command line names."""
    own = [file for file in compiled.file if inputs.is_file(folder.root / file.name)]
    names = [name for file in own for name in _with_reserved_number(file)]
    if not names:
        return []
    sources = _sources(folder, compiled)
    message = "Field numbers 19000 through 19999 are reserved for the protocol buffer library implementation"
    hint = "use another number"
    return [Diagnostic(sources.span(name, Part.NUMBER), Code.BAD_PROTO, message, hint) for name in names]


def _with_reserved_number(file: FileDescriptorProto) -> list[str]:
    """Return the full names of fields and extensions with such a number."""
    declared = [
        inside(file.package, extension.name) for extension in file.extension if extension.number in _RESERVED_NUMBERS
    ]
    for holder, _, message in holders(file):
        if isinstance(message, DescriptorProto):
            members = (*message.field, *message.extension)
            declared += [inside(holder, member.name) for member in members if member.number in _RESERVED_NUMBERS]
    return declared


_RESERVED_NUMBERS = range(FieldDescriptor.FIRST_RESERVED_FIELD_NUMBER, FieldDescriptor.LAST_RESERVED_FIELD_NUMBER + 1)


def find_envelope(schema: ProtoSchema, named: Located[str]) -> Envelope:
    """Return the envelope of the schema, with its oneof `named`.

    Raises TableError if the oneof does not exist, or if the router cannot parse a type.
    """
    name = schema.envelope
    descriptor = schema.descriptor(name)
    oneof = descriptor.oneofs_by_name.get(named.value)
    if oneof is None:
        message = f"{name} has no oneof '{named.value}'"
        raise TableError.of(named.span, Code.BAD_VALUE, message, _oneof_hint(schema, named.value))
    if refused := list(undecidable([descriptor], {field.number for field in oneof.fields}, schema.place)):
        raise TableError(refused)
    messages = [field for field in oneof.fields if field.type == FieldDescriptor.TYPE_MESSAGE]
    others = [field for field in oneof.fields if field.type != FieldDescriptor.TYPE_MESSAGE]
    cases = {field.name: payload_case(schema, field) for field in messages}
    options = {field.name: schema.board_options(field) for field in oneof.fields}
    # An unbounded case is only reported if it is sent to a board.
    bounded = [
        case.max_frame for case in cases.values() if case.max_frame is not None and not options[case.name].is_ignored
    ]
    sizes = (member_size(field, schema.board_options) for field in others)
    bounded += [size for size in sizes if size is not None]
    has_room_for_all = any(option.is_apart for option in options.values())
    max_size = sum(bounded) if has_room_for_all else max(bounded, default=0)
    max_size += largest_beside(oneof, schema.board_options)
    unroutable = {
        field.name: Unroutable(field.number, declared_type(field), encoding_of(field).wire_type) for field in others
    }
    beside = tuple(member for member in schema.messages[name].fields if member.oneof != oneof.name)
    return Envelope(
        name,
        schema,
        ByOneof(oneof.name),
        schema.message_class(name),
        cases,
        max_size,
        unroutable,
        MessageType(name, beside),
    )


def _oneof_hint(schema: ProtoSchema, name: str) -> str:
    own = _oneofs(schema.descriptor(schema.envelope))
    others = [message for message in schema.messages if name in _oneofs(schema.descriptor(message))]
    if nearest(name, own) or not others:
        alone = f"declare it: its members are the payload cases of {schema.envelope}"
        return did_you_mean(name, own) or alone
    known = f"{did_you_mean(name, own)}; " if own else ""
    return f"{known}{others[0]} has it: write `message: {others[0]}` if that is the envelope"


def _oneofs(message: Descriptor) -> list[str]:
    """Return the names of the oneofs of a message, without those that stand for `optional`."""
    return [name for name, oneof in message.oneofs_by_name.items() if name != f"_{oneof.fields[0].name}"]


def payload_case(schema: ProtoSchema, field: FieldDescriptor) -> PayloadCase:
    """Return the case that a field of the envelope is."""
    message = message_of(field)
    size = largest_encoding(message, schema.board_options)
    return PayloadCase(field.name, field.number, schema.messages[message.full_name], GetMessageClass(message), size)


def build_types(
    pool: DescriptorPool,
    file_names: Sequence[str],
    comments: Mapping[str, str],
    options_of: Callable[[FieldDescriptor], BoardOptions],
) -> tuple[dict[str, MessageType], dict[str, Enum]]:
    """Return all messages and enums of the files, nested ones included, by full name and in declared order."""
    files = [pool.FindFileByName(name) for name in file_names]
    descriptors = [
        message for file in files for top in file.message_types_by_name.values() for message in _with_nested(top)
    ]
    declared = [enum for file in files for enum in file.enum_types_by_name.values()]
    declared += [enum for message in descriptors for enum in message.enum_types]
    enums = {enum.full_name: _enum(enum) for enum in declared}
    messages = {
        message.full_name: MessageType(message.full_name, is_map_entry=message.GetOptions().map_entry)
        for message in descriptors
    }
    for message in descriptors:
        messages[message.full_name].fields = tuple(
            Field(
                name=field.name,
                type=_type(field, options_of(field), messages, enums),
                number=field.number,
                has_presence=field.has_presence,
                is_required=field.is_required or messages[message.full_name].is_map_entry,
                oneof=field.containing_oneof.name if field.containing_oneof else None,
                comment=comments.get(field.full_name, ""),
                is_unchecked=field.type == FieldDescriptor.TYPE_STRING and not validates_text(field),
                is_group=field.type == FieldDescriptor.TYPE_GROUP,
            )
            for field in message.fields
        )
    return messages, enums


def _with_nested(message: Descriptor) -> Iterator[Descriptor]:
    yield message
    for nested in message.nested_types:
        yield from _with_nested(nested)


def _enum(enum: EnumDescriptor) -> Enum:
    values = tuple((value.name, value.number) for value in enum.values)
    return Enum(enum.full_name, values, is_closed=enum.is_closed)


def _type(
    field: FieldDescriptor, options: BoardOptions, messages: Mapping[str, MessageType], enums: Mapping[str, Enum]
) -> Type:
    element = _element(field, options, messages, enums)
    if not field.is_repeated:
        return element
    count = options.max_count
    return List(element, length=count) if options.fixed_count else List(element, bound=count)


def _element(
    field: FieldDescriptor, options: BoardOptions, messages: Mapping[str, MessageType], enums: Mapping[str, Enum]
) -> Type:
    if number := encoding_of(field).type:
        return number
    if field.type == FieldDescriptor.TYPE_ENUM:
        return enums[enum_of(field).full_name]
    if field.type == FieldDescriptor.TYPE_STRING:
        return String(longest(field, options))
    if field.type == FieldDescriptor.TYPE_BYTES:
        return Bytes(longest(field, options))
    return messages[message_of(field).full_name]
