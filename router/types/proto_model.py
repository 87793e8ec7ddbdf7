"""Protobuf descriptors as our type model.

A map becomes a list of its entry messages and a group a message. Extensions are left out. Knows no files; where
things stand and what comment they carry comes from `proto_source`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

from google.protobuf.descriptor import Descriptor, EnumDescriptor, FieldDescriptor
from google.protobuf.descriptor_pool import DescriptorPool

from router.types.board_options import BoardOptions
from router.types.descriptors import enum_of, message_of
from router.types.model import Bool, Bytes, Enum, Field, Float, Int, List, MessageType, String, Type
from router.types.proto_source import ProtoSources

_SCALARS: Mapping[int, Type] = {
    FieldDescriptor.TYPE_BOOL: Bool(),
    FieldDescriptor.TYPE_FLOAT: Float(32),
    FieldDescriptor.TYPE_DOUBLE: Float(64),
    FieldDescriptor.TYPE_INT32: Int(32, signed=True),
    FieldDescriptor.TYPE_SINT32: Int(32, signed=True),
    FieldDescriptor.TYPE_SFIXED32: Int(32, signed=True),
    FieldDescriptor.TYPE_INT64: Int(64, signed=True),
    FieldDescriptor.TYPE_SINT64: Int(64, signed=True),
    FieldDescriptor.TYPE_SFIXED64: Int(64, signed=True),
    FieldDescriptor.TYPE_UINT32: Int(32, signed=False),
    FieldDescriptor.TYPE_FIXED32: Int(32, signed=False),
    FieldDescriptor.TYPE_UINT64: Int(64, signed=False),
    FieldDescriptor.TYPE_FIXED64: Int(64, signed=False),
}


def build_types(
    pool: DescriptorPool,
    file_names: Sequence[str],
    sources: ProtoSources,
    options_of: Callable[[FieldDescriptor], BoardOptions],
) -> tuple[dict[str, MessageType], dict[str, Enum]]:
    """All messages and enums of the files, nested ones too, by full name and in declared order."""
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
                comment=sources.comment(f"{message.full_name}.{field.name}"),
            )
            for field in message.fields
        )
    return messages, enums


def _with_nested(message: Descriptor) -> Iterator[Descriptor]:
    yield message
    for nested in message.nested_types:
        yield from _with_nested(nested)


def _enum(enum: EnumDescriptor) -> Enum:
    return Enum(enum.full_name, tuple((value.name, value.number) for value in enum.values))


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
    if field.type in _SCALARS:
        return _SCALARS[field.type]
    if field.type == FieldDescriptor.TYPE_ENUM:
        return enums[enum_of(field).full_name]
    if field.type == FieldDescriptor.TYPE_STRING:
        return String(options.string_size - 1 if options.string_size is not None else None)
    if field.type == FieldDescriptor.TYPE_BYTES:
        return Bytes(options.max_size)
    return messages[message_of(field).full_name]
