"""Options of nanopb's generator, which decide how a board stores each field: in `.options` files and in the protos.

The generator merges them from the outside in: those of a file, of a message or an enum in it, and of a field or oneof
in the message. At each level the matching lines of the `.options` file come first, in their order, then the
declaration itself. Tests compare the result with the generator.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import Any

from google.protobuf.descriptor import Descriptor, EnumDescriptor, FieldDescriptor, FileDescriptor
from google.protobuf.descriptor_pb2 import DescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass

from router import inputs
from router.assets import asset
from router.errors import Code, Diagnostic, SourceSpan, did_you_mean, shown_path
from router.types.descriptors import container, enum_of
from router.types.proto_files import NANOPB, Folder
from router.types.protoc import compile_protos

_EXTENSION = 1010
"""The number of nanopb's extensions of the options of files, messages, enums and fields."""

_COMMENT = re.compile(r"//.*|#.*|/\*.*?\*/")
_OPTION = re.compile(r"(?P<key>\w+)\s*:\s*(?P<value>\"[^\"]*\"|[\w.+-]+)\s*[,;]?\s*")
_COUNTS = ("max_size", "max_length", "max_count")
_STATIC = ("FT_DEFAULT", "FT_STATIC", "FT_INLINE")


@dataclass(frozen=True, slots=True)
class BoardOptions:
    """How a board stores a field. Sizes in bytes, a string's with its final NUL.

    `is_static` is False if the board stores the field by pointer or callback, which has no bound; `is_ignored` means
    that it skips the field. `is_apart`: the member of a oneof is a field like any other. `type` and `label` replace
    those of the field, if set. `int_bits` and `enum_bits` are the sizes of integers and of the field's enum, if they
    are set.
    """

    max_size: int | None = None
    max_length: int | None = None
    max_count: int | None = None
    fixed_length: bool = False
    fixed_count: bool = False
    is_static: bool = True
    is_ignored: bool = False
    is_apart: bool = False
    type: int | None = None
    label: int | None = None
    int_bits: int = 0
    enum_bits: int = 0


NO_OPTIONS = BoardOptions()


@cache
def _declared() -> DescriptorPool:
    """Return the declarations of nanopb's options. Raises StartError."""
    pool = DescriptorPool()
    for file in compile_protos(Folder(asset("schemas"), {}, {}), [NANOPB]).file:
        pool.AddSerializedFile(file.SerializeToString())
    return pool


def _no_options() -> Any:
    """Return nanopb's options, all of them unset."""
    return GetMessageClass(_declared().FindMessageTypeByName("NanoPBOptions"))()


def _own(options: Message) -> Any:
    """Return nanopb's options among those of a declaration."""
    kind = _declared().FindMessageTypeByName(options.DESCRIPTOR.full_name)
    parsed: Any = GetMessageClass(kind).FromString(options.SerializeToString())
    return parsed.Extensions[_declared().FindExtensionByNumber(kind, _EXTENSION)]


def declares_options(file: FileDescriptorProto) -> bool:
    """Return whether this is `nanopb.proto`, which may have been copied to the folder of the protos."""
    return any(
        extension.number == _EXTENSION and extension.extendee == ".google.protobuf.FieldOptions"
        for extension in file.extension
    )


# `.options` files


@dataclass(frozen=True, slots=True)
class OptionsLine:
    """A line of an `.options` file: nanopb's `options` for all full names that `pattern`, with wildcards, matches."""

    span: SourceSpan
    pattern: str
    options: Message


@dataclass(frozen=True, slots=True)
class OptionsFile:
    """The lines of one `.options` file, in order."""

    lines: tuple[OptionsLine, ...] = ()

    def unused(self, proto: FileDescriptorProto) -> Iterator[Diagnostic]:
        """Yield a warning for each line that matches nothing in its `.proto` file, which leaves a field unbounded."""
        own = _merged(_no_options(), self, proto.name, proto.options)
        names = {_in_firmware(name, proto.package, own) for name in _names(proto)}
        for line in self.lines:
            if any(fnmatchcase(name, line.pattern) for name in (*names, proto.name)):
                continue
            full = f"{proto.package}.{line.pattern}"
            lacks_package = any(fnmatchcase(name, full) for name in names)
            hint = f"names begin with the package: '{full}'" if lacks_package else did_you_mean(line.pattern, names)
            yield Diagnostic(line.span, Code.UNUSED_OPTION, f"nothing in {proto.name} is called '{line.pattern}'", hint)


def _names(proto: FileDescriptorProto) -> Iterator[tuple[str, str]]:
    """Yield the names that nanopb accepts options for: of the type without its package, and of a member or ""."""
    yield from ((enum.name, "") for enum in proto.enum_type)
    yield from ((extension.name, "") for extension in proto.extension)
    waiting = [("", message) for message in proto.message_type]
    while waiting:
        scope, message = waiting.pop()
        name = f"{scope}{message.name}"
        yield name, ""
        yield from ((name, field.name) for field in message.field)
        yield from ((name, oneof.name) for oneof in message.oneof_decl)
        yield from ((f"{name}.{enum.name}", "") for enum in message.enum_type)
        yield from ((f"{name}.{extension.name}", "") for extension in message.extension)
        waiting += [(f"{name}.", nested) for nested in message.nested_type]


def _in_firmware(name: tuple[str, str], package: str, file_options: Any) -> str:
    """Return the name that lines match: `mangle_names` and `package` change it, as they do in the generated code."""
    inside, member = name
    match _word(file_options, "mangle_names"):
        case "M_STRIP_PACKAGE":
            package = ""
        case "M_FLATTEN":
            package, inside = "", inside.rpartition(".")[2]
        case "M_PACKAGE_INITIALS":
            package = "".join(part[:1] for part in package.split("."))
        case _:
            package = file_options.package or package
    return ".".join(filter(None, (package, inside, member)))


def _word(options: Message, name: str) -> str:
    """Return the name of an enum option's value."""
    field: Any = options.DESCRIPTOR.fields_by_name[name]
    return str(field.enum_type.values_by_number[getattr(options, name)].name)


def read_options(path: Path) -> tuple[OptionsFile, list[Diagnostic]]:
    """Read an `.options` file. Return it with its findings."""
    try:
        text = inputs.read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        return OptionsFile(), [
            Diagnostic(SourceSpan(shown_path(path)), Code.BAD_FILE, f"the file cannot be read: {error}")
        ]
    lines = []
    findings = []
    for number, line in enumerate(text.splitlines(), start=1):
        bare = _COMMENT.sub("", line).strip()
        if not bare:
            continue
        pattern, *rest = bare.split(None, 1)
        options, complaints = _parsed("".join(rest))
        column = len(line) - len(line.lstrip()) + 1
        span = SourceSpan(shown_path(path), number, column, column + len(bare))
        findings += [Diagnostic(span, Code.BAD_PROTO, message, hint) for message, hint in complaints]
        lines.append(OptionsLine(replace(span, end_column=column + len(pattern)), pattern, options))
    return OptionsFile(tuple(lines)), findings


def _parsed(text: str) -> tuple[Message, Iterable[tuple[str, str]]]:
    """Return the options that a line sets, and (message, hint) for each problem."""
    from google.protobuf import text_format

    options = _no_options()
    if not text:
        return options, [("no option after the name", "write for example 'max_size:16'")]
    try:
        text_format.Merge(text, options)
    except text_format.ParseError:
        return options, [_complaint(text)]
    negative = [name for name in _COUNTS if getattr(options, name) < 0]
    return options, [(f"{name} cannot be '{getattr(options, name)}'", "") for name in negative]


def _complaint(text: str) -> tuple[str, str]:
    """Return (message, hint) for the first option of a line that nanopb does not accept."""
    from google.protobuf import text_format

    at = 0
    while option := _OPTION.match(text, at):
        known = _no_options().DESCRIPTOR.fields_by_name
        if option["key"] not in known:
            return f"nanopb has no option '{option['key']}'", did_you_mean(option["key"], known)
        try:
            text_format.Merge(option[0].rstrip(" ,;"), _no_options())
        except text_format.ParseError:
            return f"{option['key']} cannot be '{option['value']}'", ""
        at = option.end()
    return f"'{text[at:]}' is not a nanopb option", "write for example 'max_size:16'"


# Merging


def _merged(outer: Message, file: OptionsFile | None, name: str, options: Message) -> Any:
    """Return the options of a declaration inside one with the options `outer`."""
    merged = _no_options()
    merged.MergeFrom(outer)
    for line in file.lines if file is not None else ():
        if fnmatchcase(name, line.pattern):
            merged.MergeFrom(line.options)
    if options.ByteSize():
        merged.MergeFrom(_own(options))
    return merged


class NanopbOptions:
    """The merged options of fields. `files` are the `.options` files by the name of their `.proto` file."""

    def __init__(self, files: Mapping[str, OptionsFile]) -> None:
        self._files = files
        self._found: dict[FieldDescriptor, BoardOptions] = {}
        self._around: dict[FileDescriptor | Descriptor, Any] = {}

    def of(self, field: FieldDescriptor) -> BoardOptions:
        if field not in self._found:
            self._found[field] = self._of_field(field)
        return self._found[field]

    def _of_field(self, field: FieldDescriptor) -> BoardOptions:
        message = container(field)
        around = self._of_message(message)
        options = self._merged(around, message, field.name, field.GetOptions())
        union = self._union(field, around)
        is_apart = union is None or union.no_unions
        is_ignored = (
            _word(options, "type") == "FT_IGNORE"
            or (options.discard_deprecated and field.GetOptions().deprecated)
            or (not is_apart and _word(union, "type") == "FT_IGNORE")
        )
        has_label = options.HasField("label_override") and is_apart
        return BoardOptions(
            **{name: getattr(options, name) if options.HasField(name) else None for name in _COUNTS},
            fixed_length=options.fixed_length or _word(options, "type") == "FT_INLINE",
            fixed_count=options.fixed_count,
            is_static=_word(options, "type") in _STATIC,
            is_ignored=is_ignored,
            is_apart=is_apart,
            type=options.type_override if options.HasField("type_override") else None,
            label=options.label_override if has_label else None,
            int_bits=options.int_size,
            enum_bits=self._enum_bits(enum_of(field)) if field.enum_type is not None else 0,
        )

    def _merged(self, outer: Message, declared: Descriptor | EnumDescriptor, member: str, options: Message) -> Any:
        file = declared.file
        inside = declared.full_name.removeprefix(f"{file.package}.") if file.package else declared.full_name
        name = _in_firmware((inside, member), file.package, self._of_file(file))
        return _merged(outer, self._files.get(file.name), name, options)

    def _of_file(self, file: FileDescriptor) -> Any:
        if file not in self._around:
            self._around[file] = _merged(_no_options(), self._files.get(file.name), file.name, file.GetOptions())
        return self._around[file]

    def _of_message(self, message: Descriptor) -> Any:
        if message not in self._around:
            self._around[message] = self._merged(self._of_file(message.file), message, "", message.GetOptions())
        return self._around[message]

    def _union(self, field: FieldDescriptor, around: Message) -> Any:
        """Return the options of the oneof that contains a field; None if it is not a member of one."""
        message, oneof = container(field), field.containing_oneof
        if oneof is None:
            return None
        declared = DescriptorProto()
        message.CopyToProto(declared)
        if any(member.name == field.name and member.proto3_optional for member in declared.field):
            return None
        return self._merged(around, message, oneof.name, message.GetOptions())

    def _enum_bits(self, enum: EnumDescriptor) -> int:
        """Return the size that the options set for the type of an enum, 0 if they set none."""
        outer = self._of_file(enum.file) if enum.containing_type is None else self._of_message(enum.containing_type)
        options = self._merged(outer, enum, "", enum.GetOptions())
        if options.enum_intsize or not options.packed_enum:
            return int(options.enum_intsize)
        low, high = min(value.number for value in enum.values), max(value.number for value in enum.values)
        needed = max(high.bit_length(), (low + 1).bit_length()) + (low < 0)
        return next(bits for bits in (8, 16, 32) if needed <= bits)
