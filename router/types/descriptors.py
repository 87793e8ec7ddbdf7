"""References of field descriptors, without the None in protobuf's type hints, and comparisons of message types."""

from __future__ import annotations

from collections.abc import Iterator

from google.protobuf.descriptor import Descriptor, EnumDescriptor, FieldDescriptor
from google.protobuf.descriptor_pb2 import DescriptorProto, EnumDescriptorProto, FieldDescriptorProto


def container(field: FieldDescriptor) -> Descriptor:
    """Return the message that declares the field."""
    if field.containing_type is None:
        raise TypeError(f"{field.full_name} is not a member of a message")
    return field.containing_type


def message_of(field: FieldDescriptor) -> Descriptor:
    """Return the type of a message or group field."""
    if field.message_type is None:
        raise TypeError(f"{field.full_name} is not a message")
    return field.message_type


def enum_of(field: FieldDescriptor) -> EnumDescriptor:
    """Return the type of an enum field."""
    if field.enum_type is None:
        raise TypeError(f"{field.full_name} is not an enum")
    return field.enum_type


def declared_type(field: FieldDescriptor) -> str:
    """Return the type that determines a field's encoding: `sint32`, `repeated float`, `delimited Motor`."""
    if field.message_type is not None:
        name = field.message_type.full_name
        if field.type == FieldDescriptor.TYPE_GROUP:
            name = f"delimited {name}"
    elif field.enum_type is not None:
        name = f"enum {field.enum_type.full_name}"
    else:
        name = FieldDescriptorProto.Type.Name(FieldDescriptorProto.Type.ValueType(field.type))
        name = name.removeprefix("TYPE_").lower()
    label = "repeated " if field.is_repeated else "required " if field.is_required else ""
    return label + name


def all_types(*roots: Descriptor) -> dict[Descriptor, int]:
    """Return these messages and all types of their fields, at any depth, each with an index; the first one's is 0."""
    indexes = {root: index for index, root in enumerate(dict.fromkeys(roots))}
    pending = [*indexes]
    while pending:
        for field in all_fields(pending.pop()):
            if field.message_type is not None and field.message_type not in indexes:
                indexes[field.message_type] = len(indexes)
                pending.append(field.message_type)
    return indexes


def all_fields(descriptor: Descriptor) -> Iterator[FieldDescriptor]:
    """Yield the fields of a message and the extensions in its pool: protobuf parses both in the same way."""
    yield from descriptor.fields
    if descriptor.is_extendable:
        yield from descriptor.file.pool.FindAllExtensions(descriptor)


def same_type(one: Descriptor, other: Descriptor) -> bool:
    """Return whether two messages of different `.proto` files have the same name and declarations, at any depth."""
    return one.full_name == other.full_name and _declarations(one) == _declarations(other)


def _declarations(message: Descriptor) -> dict[str, bytes]:
    """Return the declaration of a message and of each message and enum in it, by full name."""
    declared: dict[str, bytes] = {}
    for each in all_types(message):
        own = DescriptorProto()
        each.CopyToProto(own)
        declared[each.full_name] = own.SerializeToString(deterministic=True)
        for enum in (field.enum_type for field in each.fields if field.enum_type is not None):
            values = EnumDescriptorProto()
            enum.CopyToProto(values)
            declared[enum.full_name] = values.SerializeToString(deterministic=True)
    return declared
