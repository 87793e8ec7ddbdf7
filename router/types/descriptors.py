"""References of field descriptors, without the None in protobuf's type hints, and the spelling of field types."""

from __future__ import annotations

from google.protobuf.descriptor import Descriptor, EnumDescriptor, FieldDescriptor
from google.protobuf.descriptor_pb2 import FieldDescriptorProto


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
