"""What a field's descriptor refers to, and how its `.proto` file spells its type.

protobuf's type hints allow None wherever a field may be of another kind.
"""

from __future__ import annotations

from google.protobuf.descriptor import Descriptor, EnumDescriptor, FieldDescriptor
from google.protobuf.descriptor_pb2 import FieldDescriptorProto


def container(field: FieldDescriptor) -> Descriptor:
    """The message that declares the field."""
    if field.containing_type is None:
        raise TypeError(f"{field.full_name} is no member of a message")
    return field.containing_type


def message_of(field: FieldDescriptor) -> Descriptor:
    """The type of a message or group field."""
    if field.message_type is None:
        raise TypeError(f"{field.full_name} is no message")
    return field.message_type


def enum_of(field: FieldDescriptor) -> EnumDescriptor:
    """The type of an enum field."""
    if field.enum_type is None:
        raise TypeError(f"{field.full_name} is no enum")
    return field.enum_type


def declared_type(field: FieldDescriptor) -> str:
    """`sint32`, `repeated float`, `delimited Motor`: what decides a field's bytes on the wire."""
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
