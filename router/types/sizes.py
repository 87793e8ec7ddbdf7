"""The largest encoding of a protobuf message in bytes, as nanopb computes it for its `*_size` macros.

Boards reject a datagram that is longer than that. Counting rules are nanopb's, checked against its
generator in the tests: an int32 takes up to 10 bytes, an enum as many as its largest declared value.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from google.protobuf.descriptor import Descriptor, FieldDescriptor, OneofDescriptor

from router.types.board_options import BoardOptions
from router.types.descriptors import enum_of, message_of

OptionsOf = Callable[[FieldDescriptor], BoardOptions]

_FIXED = {
    FieldDescriptor.TYPE_BOOL: 1,
    FieldDescriptor.TYPE_DOUBLE: 8,
    FieldDescriptor.TYPE_FIXED32: 4,
    FieldDescriptor.TYPE_FIXED64: 8,
    FieldDescriptor.TYPE_FLOAT: 4,
    FieldDescriptor.TYPE_INT32: 10,
    FieldDescriptor.TYPE_INT64: 10,
    FieldDescriptor.TYPE_SFIXED32: 4,
    FieldDescriptor.TYPE_SFIXED64: 8,
    FieldDescriptor.TYPE_SINT32: 5,
    FieldDescriptor.TYPE_SINT64: 10,
    FieldDescriptor.TYPE_UINT32: 5,
    FieldDescriptor.TYPE_UINT64: 10,
}


@dataclass(frozen=True, slots=True)
class Unbounded:
    """A field without a largest encoding; `path` leads to it from the message that was asked for."""

    path: tuple[FieldDescriptor, ...]
    why: str


def largest_encoding(message: Descriptor, options_of: OptionsOf) -> int | None:
    """The largest encoding of a message in bytes, None where a field has no bound.

    Of a oneof only the largest member counts. Extensions do not count.
    """
    if any(unbounded_fields(message, options_of)):
        return None
    return _message_size(message, options_of)


def largest_beside(oneof: OneofDescriptor, options_of: OptionsOf) -> int:
    """The largest encoding of what a message holds beside one of its oneofs, fields without a bound left out."""
    message = oneof.containing_type
    unbounded = {found.path[0] for found in unbounded_fields(message, options_of)}
    members = {*oneof.fields, *unbounded}
    return _size_of([field for field in message.fields if field not in members], options_of)


def framed_size(number: int, payload: int) -> int:
    """The encoding of message field `number` in bytes: tag, length, and a payload of `payload` bytes."""
    return _varint_size(number << 3) + _varint_size(payload) + payload


def unbounded_fields(
    message: Descriptor, options_of: OptionsOf, path: tuple[FieldDescriptor, ...] = ()
) -> Iterator[Unbounded]:
    """Every field inside the message, at any depth, that has no largest encoding."""
    inside = {step.containing_type for step in path}
    for field in message.fields:
        here = (*path, field)
        if why := _why_unbounded(field, options_of(field)):
            yield Unbounded(here, why)
        elif field.message_type is None:
            continue
        elif field.message_type == message or field.message_type in inside:
            yield Unbounded(here, "contains itself")
        else:
            yield from unbounded_fields(field.message_type, options_of, here)


def _why_unbounded(field: FieldDescriptor, options: BoardOptions) -> str | None:
    if field.type == FieldDescriptor.TYPE_GROUP:
        return "is a group, which nanopb does not know"
    if field.is_repeated and options.max_count is None:
        return "is repeated without a max_count"
    if field.type == FieldDescriptor.TYPE_STRING and options.string_size is None:
        return "is a string without a max_size"
    if field.type == FieldDescriptor.TYPE_BYTES and options.max_size is None:
        return "is bytes without a max_size"
    if not options.is_static:
        return "is held by pointer or callback"
    return None


def _message_size(message: Descriptor, options_of: OptionsOf) -> int:
    return _size_of(message.fields, options_of)


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
    size = _varint_size(field.number << 3) + _value_size(field, options, options_of)
    if not field.is_repeated or options.max_count is None:
        return size
    # Room for the unpacked form, which every decoder must take; for one element the packed form is longer.
    return size * options.max_count + (1 if options.max_count == 1 else 0)


def _value_size(field: FieldDescriptor, options: BoardOptions, options_of: OptionsOf) -> int:
    if field.type in _FIXED:
        return _FIXED[field.type]
    if field.type == FieldDescriptor.TYPE_ENUM:
        return max(_varint_size(value.number) for value in enum_of(field).values)
    if field.type == FieldDescriptor.TYPE_MESSAGE:
        inner = _message_size(message_of(field), options_of)
        return _varint_size(inner) + inner
    if field.type == FieldDescriptor.TYPE_STRING:
        size = options.string_size or 1
        return _varint_size(size) + size - 1  # without its final NUL
    size = options.max_size or 0
    return _varint_size(size) + size


def _varint_size(value: int) -> int:
    """Bytes of a varint; a negative one has ten."""
    return 10 if value < 0 else max(1, (value.bit_length() + 6) // 7)
