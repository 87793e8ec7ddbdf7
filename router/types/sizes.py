"""The largest encoding of a protobuf message in bytes, as nanopb computes it for its `*_size` macros.

Boards reject a datagram that is longer than that. Counting rules are nanopb's, checked against its
generator in the tests: a negative int32 takes 10 bytes, an enum as many as its largest declared value.
"""

from __future__ import annotations

from collections.abc import Callable

from google.protobuf.descriptor import Descriptor, FieldDescriptor

from router.types.board_options import BoardOptions

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


class UnboundedError(Exception):
    """A field that has no largest encoding; `path` leads to it from the message asked for."""

    def __init__(self, path: tuple[FieldDescriptor, ...], why: str) -> None:
        super().__init__(why)
        self.path = path
        self.why = why


def largest_encoding(message: Descriptor, options_of: OptionsOf, inside: tuple[Descriptor, ...] = ()) -> int:
    """The largest encoding of a message in bytes. Raises UnboundedError at the first field without a bound.

    Of a oneof only the largest member counts.
    """
    if message in inside:
        raise UnboundedError((), "a message that contains itself")
    total = 0
    in_oneofs: dict[str, int] = {}
    for field in message.fields:
        size = field_size(field, options_of, (*inside, message))
        if field.containing_oneof is None:
            total += size
        else:
            oneof = field.containing_oneof.name
            in_oneofs[oneof] = max(in_oneofs.get(oneof, 0), size)
    return total + sum(in_oneofs.values())


def field_size(field: FieldDescriptor, options_of: OptionsOf, inside: tuple[Descriptor, ...] = ()) -> int:
    """The largest encoding of a field with its tags. Raises UnboundedError."""
    options = options_of(field)
    if not options.is_static:
        raise UnboundedError((field,), "held by pointer or callback on the board")
    size = varint_size(field.number << 3) + _value_size(field, options, options_of, inside)
    if not field.is_repeated:
        return size
    if options.max_count is None:
        raise UnboundedError((field,), "repeated without a max_count")
    # Room for the unpacked form, which every decoder must take; for one element the packed form is longer.
    return size * options.max_count + (1 if options.max_count == 1 else 0)


def _value_size(
    field: FieldDescriptor, options: BoardOptions, options_of: OptionsOf, inside: tuple[Descriptor, ...]
) -> int:
    if field.type in _FIXED:
        return _FIXED[field.type]
    if field.type == FieldDescriptor.TYPE_ENUM:
        return max(varint_size(value.number) for value in field.enum_type.values)
    if field.type == FieldDescriptor.TYPE_STRING:
        if options.string_size is None:
            raise UnboundedError((field,), "string without a max_size")
        return varint_size(options.string_size) + options.string_size - 1
    if field.type == FieldDescriptor.TYPE_BYTES:
        if options.max_size is None:
            raise UnboundedError((field,), "bytes without a max_size")
        return varint_size(options.max_size) + options.max_size
    if field.type == FieldDescriptor.TYPE_GROUP:
        raise UnboundedError((field,), "a group, which nanopb cannot encode")
    try:
        inner = largest_encoding(field.message_type, options_of, inside)
    except UnboundedError as error:
        raise UnboundedError((field, *error.path), error.why) from None
    return varint_size(inner) + inner


def varint_size(value: int) -> int:
    """Bytes of a varint; a negative one has ten."""
    return 10 if value < 0 else max(1, (value.bit_length() + 6) // 7)
