"""`protos/` has what contract.txt lists: files, names, numbers and types of ERC-Protobufs at a303ae3 (see NOTICE)."""

from __future__ import annotations

import re
from pathlib import Path

from google.protobuf.descriptor import Descriptor, EnumDescriptor, FieldDescriptor

from router.types.protobuf import ProtoSchema

CONTRACT = Path(__file__).with_name("contract.txt").read_text()

SCALARS = {
    getattr(FieldDescriptor, f"TYPE_{name.upper()}"): name
    for name in ("bool", "int32", "int64", "uint32", "uint64", "sint32", "sint64", "float", "double")
}

# (file, kind, name, entries): entries are (number, name, type) of fields and (number, name, "") of enum values
Declaration = tuple[str, str, str, frozenset[tuple[int, str, str]]]


def contract_declarations(text: str) -> set[Declaration]:
    declared: set[Declaration] = set()
    file, name, fields = "", "", set[tuple[int, str, str]]()
    for line in [*text.splitlines(), "end:"]:
        if found := re.fullmatch(r"    (\d+): (\w+) ([\w.]+)", line):
            fields.add((int(found[1]), found[2], found[3]))
            continue
        if name:
            declared.add((file, "message", name, frozenset(fields)))
            name, fields = "", set()
        if found := re.fullmatch(r"  enum ([\w.]+): (.*)", line):
            values = (value.split("=") for value in found[2].split(", "))
            declared.add((file, "enum", found[1], frozenset((int(number), value, "") for value, number in values)))
        elif found := re.fullmatch(r"  message (\w+):(?: oneof payload)?", line):
            name = found[1]
        else:
            file = line.removesuffix(":")
    return declared


def type_name(field: FieldDescriptor) -> str:
    declared = field.message_type or field.enum_type
    return declared.full_name if declared is not None else SCALARS[field.type]


def message_declaration(message: Descriptor) -> Declaration:
    fields = frozenset((field.number, field.name, type_name(field)) for field in message.fields)
    return message.file.name, "message", message.full_name, fields


def enum_declaration(enum: EnumDescriptor) -> Declaration:
    values = frozenset((value.number, value.name, "") for value in enum.values)
    return enum.file.name, "enum", enum.full_name, values


def proto_declarations(schema: ProtoSchema) -> set[Declaration]:
    pool = schema.descriptor("PBEnvelope").file.pool
    files = [pool.FindFileByName(name) for name in schema.files if name.endswith(".proto")]
    messages = [message for file in files for message in file.message_types_by_name.values()]
    nested = [enum for message in messages for enum in message.enum_types]
    enums = [*nested, *(enum for file in files for enum in file.enum_types_by_name.values())]
    return {message_declaration(message) for message in messages} | {enum_declaration(enum) for enum in enums}


def test_protos_have_all_that_the_contract_has_as_it_has_it(schema: ProtoSchema) -> None:
    """What the rover has been given since, new fields and new messages, is the lock's business."""
    ours = {declared[:3]: declared[3] for declared in proto_declarations(schema)}
    for file, kind, name, entries in contract_declarations(CONTRACT):
        assert entries <= ours[file, kind, name]


def test_every_message_is_in_proto3_without_a_package_and_every_field_single(schema: ProtoSchema) -> None:
    for name in schema.messages:
        descriptor = schema.descriptor(name)
        assert descriptor.file.package == ""
        assert not [field.name for field in descriptor.fields if field.is_repeated or field.is_required], name
