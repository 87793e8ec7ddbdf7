"""Sizes that a board can decode: boards decode with nanopb into structures of a fixed size.

nanopb's `.options` files limit strings, bytes and repeated fields. The largest encoding of a message in bytes equals
nanopb's `*_size` macro; boards reject longer datagrams. Tests compare the sizes with nanopb's generator: an int32 takes
up to 10 bytes, an enum as many as its largest declared value.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING

from google.protobuf.descriptor import Descriptor, FieldDescriptor, OneofDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorProto

from router import inputs
from router.errors import Code, Diagnostic, SourceSpan, did_you_mean, shown_path
from router.types.descriptors import container, enum_of, message_of
from router.types.wire import encoding_of, varint

_COMMENT = re.compile(r"//.*|#.*|/\*.*?\*/")
_OPTION = re.compile(r"(?P<key>\w+)\s*:\s*(?P<value>\"[^\"]*\"|[\w.+-]+)\s*[,;]?\s*")
_COUNTS = frozenset({"max_size", "max_length", "max_count"})
_FLAGS = frozenset({"fixed_length", "fixed_count"})
_WITHOUT_INFLUENCE = frozenset(
    {
        "long_names", "packed_struct", "packed_enum", "msgid", "anonymous_oneof", "proto3", "proto3_singular_msgs",
        "enum_to_string", "enum_validate", "mangle_names", "callback_datatype", "callback_function", "descriptorsize",
        "default_has", "include", "exclude", "package", "sort_by_tag", "initializer", "enum_intsize",
        "discard_unused_automatic_types", "discard_deprecated",
    }
)  # fmt: skip
_TYPES = {"FT_DEFAULT": True, "FT_STATIC": True, "FT_INLINE": True, "FT_CALLBACK": False, "FT_POINTER": False}


@dataclass(frozen=True, slots=True)
class BoardOptions:
    """nanopb's options of one field. Sizes in bytes, a string's with its final NUL.

    `is_static` is False if the board stores the field by pointer or callback, which has no bound.
    """

    max_size: int | None = None
    max_length: int | None = None
    max_count: int | None = None
    fixed_length: bool = False
    fixed_count: bool = False
    is_static: bool = True

    @property
    def string_size(self) -> int | None:
        """The size of a string with its NUL: from `max_length`, else `max_size`."""
        return self.max_length + 1 if self.max_length is not None else self.max_size


NO_OPTIONS = BoardOptions()


@dataclass(frozen=True, slots=True)
class OptionsLine:
    """A line of an `.options` file: `changes` for all full names that `pattern`, with wildcards, matches."""

    span: SourceSpan
    pattern: str
    changes: Mapping[str, int | bool]


@dataclass(frozen=True, slots=True)
class OptionsFile:
    """The lines of one `.options` file, in order."""

    lines: tuple[OptionsLine, ...] = ()

    def of(self, message: str, field: str) -> BoardOptions:
        """Return the options of a field, by the full name of its message and its own name.

        As in nanopb, options of a message apply to its fields, and later lines override earlier ones.
        """
        options = NO_OPTIONS
        for name in (message, f"{message}.{field}"):
            for line in self.lines:
                if fnmatchcase(name, line.pattern):
                    options = replace(options, **line.changes)  # type: ignore[arg-type]
        return options

    def unused(self, proto: FileDescriptorProto) -> Iterator[Diagnostic]:
        """Yield a warning for each line that matches nothing in its `.proto` file, which leaves a field unbounded."""
        names = set(_names(proto))
        for line in self.lines:
            if any(fnmatchcase(name, line.pattern) for name in names):
                continue
            full = f"{proto.package}.{line.pattern}"
            lacks_package = any(fnmatchcase(name, full) for name in names)
            hint = f"names begin with the package: '{full}'" if lacks_package else did_you_mean(line.pattern, names)
            yield Diagnostic(line.span, Code.UNUSED_OPTION, f"nothing in {proto.name} is called '{line.pattern}'", hint)


def _names(proto: FileDescriptorProto) -> Iterator[str]:
    """Yield the full names that nanopb accepts options for."""
    scope = f"{proto.package}." if proto.package else ""
    yield from (f"{scope}{enum.name}" for enum in proto.enum_type)
    yield from (f"{scope}{extension.name}" for extension in proto.extension)
    waiting = [(scope, message) for message in proto.message_type]
    while waiting:
        scope, message = waiting.pop()
        inside = f"{scope}{message.name}."
        yield inside[:-1]
        yield from (f"{inside}{field.name}" for field in (*message.field, *message.extension))
        yield from (f"{inside}{oneof.name}" for oneof in message.oneof_decl)
        yield from (f"{inside}{enum.name}" for enum in message.enum_type)
        waiting += [(inside, nested) for nested in message.nested_type]


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
        pattern, _, rest = bare.partition(" ") if " " in bare else bare.partition("\t")
        changes, complaints = _changes(rest)
        column = len(line) - len(line.lstrip()) + 1
        span = SourceSpan(shown_path(path), number, column, column + len(bare))
        findings += [Diagnostic(span, Code.BAD_PROTO, message, hint) for message, hint in complaints]
        lines.append(OptionsLine(replace(span, end_column=column + len(pattern)), pattern, changes))
    return OptionsFile(tuple(lines)), findings


def _changes(text: str) -> tuple[Mapping[str, int | bool], Iterable[tuple[str, str]]]:
    """Return the options that a line sets, and (message, hint) for each problem."""
    text = text.strip()
    changes: dict[str, int | bool] = {}
    if not text:
        return changes, [("no option after the name", "write for example 'max_size:16'")]
    at = 0
    while at < len(text):
        option = _OPTION.match(text, at)
        if option is None:
            return changes, [(f"'{text[at:]}' is not a nanopb option", "write for example 'max_size:16'")]
        at = option.end()
        key, value = option["key"], option["value"]
        if key in _COUNTS and value.isdecimal():
            changes[key] = int(value)
        elif key in _FLAGS and value in ("true", "false"):
            changes[key] = value == "true"
        elif key == "type" and value in _TYPES:
            changes["is_static"] = _TYPES[value]
        elif key in _COUNTS | _FLAGS | {"type"}:
            return changes, [(f"{key} cannot be '{value}'", "")]
        elif key not in _WITHOUT_INFLUENCE:
            hint = did_you_mean(key, _COUNTS | _FLAGS | {"type"})
            return changes, [(f"the router cannot compute sizes with the nanopb option '{key}'", hint)]
    return changes, []


if TYPE_CHECKING:
    from router.types.protobuf import PayloadCase, ProtoSchema

OptionsOf = Callable[[FieldDescriptor], BoardOptions]

# Sizes


@dataclass(frozen=True, slots=True)
class Unbounded:
    """A field without a largest encoding; `path` leads to it from the message that was examined."""

    path: tuple[FieldDescriptor, ...]
    why: str


def largest_encoding(message: Descriptor, options_of: OptionsOf) -> int | None:
    """Return the largest encoding of a message in bytes, None if a field has no bound.

    Only the largest member of a oneof counts. Extensions do not count.
    """
    if any(unbounded_fields(message, options_of)):
        return None
    return _size_of(message.fields, options_of)


def largest_beside(oneof: OneofDescriptor, options_of: OptionsOf) -> int:
    """Return the largest encoding of a message without one of its oneofs. Fields without a bound do not count."""
    message = oneof.containing_type
    unbounded = {found.path[0] for found in unbounded_fields(message, options_of)}
    members = {*oneof.fields, *unbounded}
    return _size_of([field for field in message.fields if field not in members], options_of)


def framed_size(number: int, payload: int) -> int:
    """Return the size of message field `number` in bytes: tag, length, and a payload of `payload` bytes."""
    return len(varint(number << 3)) + len(varint(payload)) + payload


def unbounded_fields(
    message: Descriptor, options_of: OptionsOf, path: tuple[FieldDescriptor, ...] = ()
) -> Iterator[Unbounded]:
    """Yield every field inside the message, at any depth, that has no largest encoding."""
    inside = {step.containing_type for step in path}
    for field in message.fields:
        here = (*path, field)
        if why := why_unbounded(field, options_of(field)):
            yield Unbounded(here, why)
        elif field.message_type is None:
            continue
        elif field.message_type == message or field.message_type in inside:
            yield Unbounded(here, "contains itself")
        else:
            yield from unbounded_fields(field.message_type, options_of, here)


def why_unbounded(field: FieldDescriptor, options: BoardOptions) -> str | None:
    """Return why a field has no largest encoding, None if it has one. The fields inside it are not considered."""
    if field.type == FieldDescriptor.TYPE_GROUP:
        return "is a group, which nanopb does not support"
    if field.is_repeated and options.max_count is None:
        return "is repeated without a max_count"
    if field.type == FieldDescriptor.TYPE_STRING and options.string_size is None:
        return "is a string without a max_size"
    if field.type == FieldDescriptor.TYPE_BYTES and options.max_size is None:
        return "is bytes without a max_size"
    if not options.is_static:
        return "is stored by pointer or callback"
    return None


def _size_of(fields: Iterable[FieldDescriptor], options_of: OptionsOf) -> int:
    total = 0
    in_oneofs: dict[str, int] = {}
    for field in fields:
        size = _field_size(field, options_of)
        if field.containing_oneof is None:
            total += size
        else:
            oneof = field.containing_oneof.name
            in_oneofs[oneof] = max(in_oneofs.get(oneof, 0), size)
    return total + sum(in_oneofs.values())


def _field_size(field: FieldDescriptor, options_of: OptionsOf) -> int:
    options = options_of(field)
    size = len(varint(field.number << 3)) + _value_size(field, options, options_of)
    if not field.is_repeated or options.max_count is None:
        return size
    # Room for the unpacked form, which every decoder must accept; for one element the packed form is longer.
    return size * options.max_count + (1 if options.max_count == 1 else 0)


def _value_size(field: FieldDescriptor, options: BoardOptions, options_of: OptionsOf) -> int:
    if number := encoding_of(field).size:
        return number
    if field.type == FieldDescriptor.TYPE_ENUM:
        return max(len(varint(value.number)) for value in enum_of(field).values)
    if field.type == FieldDescriptor.TYPE_MESSAGE:
        inner = _size_of(message_of(field).fields, options_of)
        return len(varint(inner)) + inner
    if field.type == FieldDescriptor.TYPE_STRING:
        size = options.string_size or 1
        return len(varint(size)) + size - 1  # without its final NUL
    size = options.max_size or 0
    return len(varint(size)) + size


def board_findings(case: PayloadCase, schema: ProtoSchema, limit: int, span: SourceSpan) -> list[Diagnostic]:
    """Return findings if a board cannot decode this payload case.

    `limit` is the largest envelope in bytes that boards accept, `span` the place in the table that sends the case to a
    board.
    """
    unbounded = unbounded_fields(schema.descriptor(case.type.name), schema.board_options)
    findings = [_unbounded_finding(case, found, schema, span) for found in unbounded]
    if case.max_size is not None and (size := framed_size(case.number, case.max_size)) > limit:
        message = f"an envelope with {case.name} takes up to {size} bytes; boards reject more than {limit}"
        hint = f"see {schema.span(case.type.name)}; make the message smaller, or flash the boards and lock the new size"
        findings.append(Diagnostic(span, Code.BOARD_PAYLOAD, message, hint))
    return findings


def _unbounded_finding(case: PayloadCase, found: Unbounded, schema: ProtoSchema, span: SourceSpan) -> Diagnostic:
    field = found.path[-1]
    path = ".".join((case.name, *(step.name for step in found.path)))
    place = schema.span(container(field).full_name, field.name)
    hint = f"see {place}; limit its size in a nanopb .options file beside the .proto"
    return Diagnostic(span, Code.BOARD_PAYLOAD, f"a board cannot decode {path}: it {found.why}", hint)
