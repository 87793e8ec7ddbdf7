"""Sizes that a board can decode: boards decode with nanopb into structures of a fixed size.

nanopb's options (`nanopb.py`) limit strings, bytes, integers and repeated fields. The largest encoding of a message in
bytes equals nanopb's `*_size` macro; boards reject longer datagrams. Tests compare the sizes with nanopb's generator:
an int32 takes up to 10 bytes, an enum as many as its largest declared value.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from google.protobuf.descriptor import Descriptor, FieldDescriptor, OneofDescriptor
from google.protobuf.descriptor_pb2 import FieldDescriptorProto

from router.errors import Code, Diagnostic, SourceSpan
from router.types.descriptors import container, enum_of, message_of
from router.types.model import Int
from router.types.nanopb import BoardOptions
from router.types.wire import encoding, varint

if TYPE_CHECKING:
    from router.types.protobuf import PayloadCase, ProtoSchema

OptionsOf = Callable[[FieldDescriptor], BoardOptions]

# Fields


def stored_type(field: FieldDescriptor, options: BoardOptions) -> int:
    """Return the type of a field in the firmware."""
    return options.type if options.type is not None else field.type


def is_list(field: FieldDescriptor, options: BoardOptions) -> bool:
    """Return whether the firmware has a list for a field."""
    return field.is_repeated if options.label is None else options.label == FieldDescriptorProto.LABEL_REPEATED


def is_required(field: FieldDescriptor, options: BoardOptions) -> bool:
    """Return whether the firmware refuses a message without a field."""
    return field.is_required if options.label is None else options.label == FieldDescriptorProto.LABEL_REQUIRED


def longest(field: FieldDescriptor, options: BoardOptions) -> int | None:
    """Return the largest size of a string or bytes in bytes, None without a limit."""
    size = options.max_size
    if field.type == FieldDescriptor.TYPE_STRING and options.max_length is not None:
        size = options.max_length + 1
    if size is not None and stored_type(field, options) == FieldDescriptor.TYPE_STRING:
        size = max(size, 1) - 1  # without its final NUL
    return size


def integers(field: FieldDescriptor, options: BoardOptions) -> Int | None:
    """Return the integers that the firmware takes, None if the options do not restrict them."""
    if (kind := stored_type(field, options)) == FieldDescriptor.TYPE_ENUM:
        has_negative = any(value.number < 0 for value in enum_of(field).values)
        return Int(options.enum_bits, has_negative) if 0 < options.enum_bits < _ENUM_BITS else None
    whole = encoding(kind).type if kind in _SIZED else None
    return Int(options.int_bits, whole.signed) if isinstance(whole, Int) and 0 < options.int_bits < whole.bits else None


_ENUM_BITS = 32
_SIZED = (
    FieldDescriptor.TYPE_INT32, FieldDescriptor.TYPE_INT64, FieldDescriptor.TYPE_UINT32, FieldDescriptor.TYPE_UINT64,
    FieldDescriptor.TYPE_SINT32, FieldDescriptor.TYPE_SINT64,
)  # fmt: skip
"""The types that `int_size` applies to."""

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
    return largest_fields([field for field in oneof.containing_type.fields if field not in oneof.fields], options_of)


def largest_fields(fields: Sequence[FieldDescriptor], options_of: OptionsOf) -> int:
    """Return the largest encoding of some fields of a message. Fields without a bound do not count."""
    unbounded = {field.path[0] for field in unbounded_fields(container(fields[0]), options_of)} if fields else set()
    return _size_of([field for field in fields if field not in unbounded], options_of)


def member_size(field: FieldDescriptor, options_of: OptionsOf) -> int | None:
    """Return the largest encoding of a scalar with its tag in bytes; None if it has no bound, or is ignored."""
    options = options_of(field)
    if options.is_ignored or why_unbounded(field, options):
        return None
    return _field_size(field, options, options_of)


def unbounded_fields(
    message: Descriptor, options_of: OptionsOf, path: tuple[FieldDescriptor, ...] = ()
) -> Iterator[Unbounded]:
    """Yield every field inside the message, at any depth, that has no largest encoding. Ignored ones are omitted."""
    inside = {step.containing_type for step in path}
    for field in message.fields:
        here, options = (*path, field), options_of(field)
        if options.is_ignored:
            continue
        if why := why_unbounded(field, options):
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
    if encoding(stored_type(field, options)).wire_type != encoding(field.type).wire_type:
        return "has another wire type in the firmware, by type_override"
    if field.is_repeated and not is_list(field, options):
        return "is repeated, but has one value in the firmware, by label_override"
    if is_list(field, options) and options.max_count is None:
        return "is repeated without a max_count"
    if field.type in _TEXTS and longest(field, options) is None:
        return f"is {_TEXTS[field.type]} without a max_size"
    if not options.is_static:
        return "is stored by pointer or callback"
    return None


_TEXTS = {FieldDescriptor.TYPE_STRING: "a string", FieldDescriptor.TYPE_BYTES: "bytes"}


def _size_of(fields: Iterable[FieldDescriptor], options_of: OptionsOf) -> int:
    total = 0
    in_oneofs: dict[str, int] = {}
    for field in fields:
        options = options_of(field)
        size = _field_size(field, options, options_of) if not options.is_ignored else 0
        if field.containing_oneof is None or options.is_apart:
            total += size
        else:
            oneof = field.containing_oneof.name
            in_oneofs[oneof] = max(in_oneofs.get(oneof, 0), size)
    return total + sum(in_oneofs.values())


def _field_size(field: FieldDescriptor, options: BoardOptions, options_of: OptionsOf) -> int:
    size = len(varint(field.number << 3)) + _value_size(field, options, options_of)
    if not is_list(field, options) or options.max_count is None:
        return size
    # Room for the unpacked form, which every decoder must accept; for one element the packed form is longer.
    return size * options.max_count + (1 if options.max_count == 1 else 0)


def _value_size(field: FieldDescriptor, options: BoardOptions, options_of: OptionsOf) -> int:
    kind = stored_type(field, options)
    if number := encoding(kind).size:
        return _SMALL.get(options.int_bits, number) if kind in _SHORTENED else number
    if kind == FieldDescriptor.TYPE_ENUM:
        return max(len(varint(value.number)) for value in enum_of(field).values)
    if kind == FieldDescriptor.TYPE_MESSAGE:
        inner = _size_of(message_of(field).fields, options_of)
        return len(varint(inner)) + inner
    size = longest(field, options) or 0
    return len(varint(size + (kind == FieldDescriptor.TYPE_STRING))) + size


_SMALL = {8: 2, 16: 3, 32: 5, 64: 10}
"""The largest encodings in bytes of integers by the bits of `int_size`, for the types that nanopb shortens."""
_SHORTENED = tuple(kind for kind in _SIZED if kind not in (FieldDescriptor.TYPE_INT32, FieldDescriptor.TYPE_INT64))


def board_findings(case: PayloadCase, schema: ProtoSchema, limit: int, span: SourceSpan) -> list[Diagnostic]:
    """Return findings if a board cannot decode this payload case.

    `limit` is the largest envelope in bytes that boards accept, `span` the place in the table that sends the case to a
    board.
    """
    member = schema.descriptor(schema.envelope).fields_by_number.get(case.wrapping.tag >> 3)
    if member is not None and member.type == FieldDescriptor.TYPE_BYTES:
        most = longest(member, schema.board_options(member))
        if most is not None and case.max_size is not None and case.max_size > most:
            message = f"{case.name} takes up to {case.max_size} bytes; {member.full_name} has room for {most}"
            hint = f"see {schema.span(schema.envelope, member.name)}; give it room, or make the message smaller"
            return [Diagnostic(span, Code.BOARD_PAYLOAD, message, hint)]
    if member is not None and schema.board_options(member).is_ignored:
        message = f"a board ignores {case.name}: nanopb's options leave it out of the firmware"
        hint = f"see {schema.span(schema.envelope, member.name)}; remove `type:FT_IGNORE`"
        return [Diagnostic(span, Code.BOARD_PAYLOAD, message, hint)]
    unbounded = unbounded_fields(schema.descriptor(case.type.name), schema.board_options)
    findings = [_unbounded_finding(case, field, schema, span) for field in unbounded]
    if (size := case.max_frame) is not None and size > limit:
        message = f"an envelope with {case.name} takes up to {size} bytes; boards reject more than {limit}"
        hint = f"see {schema.span(case.type.name)}; make the message smaller, or flash the boards and lock the new size"
        findings.append(Diagnostic(span, Code.BOARD_PAYLOAD, message, hint))
    return findings


def _unbounded_finding(case: PayloadCase, unbounded: Unbounded, schema: ProtoSchema, span: SourceSpan) -> Diagnostic:
    field = unbounded.path[-1]
    path = ".".join((case.name, *(step.name for step in unbounded.path)))
    place = schema.span(container(field).full_name, field.name)
    option = unbounded.why.partition(" without a ")[2]
    remedy = ""
    if option:
        remedy = f"; write `{field.full_name} {option}:N` into a nanopb .options file beside the .proto"
    elif "_override" in unbounded.why or "pointer or callback" in unbounded.why:
        remedy = "; remove that option"
    hint = f"see {place}{remedy}"
    return Diagnostic(span, Code.BOARD_PAYLOAD, f"a board cannot decode {path}: it {unbounded.why}", hint)
