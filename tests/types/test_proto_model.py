"""Every kind of protobuf declaration in the type model."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import pytest

from router.types.model import Bool, Bytes, Enum, Float, Int, List, String, Type
from router.types.protobuf import ProtoSchema

Load = Callable[[Mapping[str, str]], ProtoSchema]

I32, I64, U32, U64 = Int(32, True), Int(64, True), Int(32, False), Int(64, False)


@pytest.mark.parametrize(
    ("declared", "type_"),
    [
        ("bool", Bool()), ("float", Float(32)), ("double", Float(64)), ("string", String()), ("bytes", Bytes()),
        ("int32", I32), ("sint32", I32), ("sfixed32", I32), ("uint32", U32), ("fixed32", U32),
        ("int64", I64), ("sint64", I64), ("sfixed64", I64), ("uint64", U64), ("fixed64", U64),
        ("repeated float", List(Float(32))),
    ],
)  # fmt: skip
def test_scalars(load: Load, declared: str, type_: Type) -> None:
    schema = load({"a.proto": f'syntax = "proto3";\nmessage A {{ {declared} x = 7; }}'})
    (field,) = schema.messages["A"].fields
    assert (field.name, field.number, field.type) == ("x", 7, type_)


def test_fields_keep_their_declared_order(load: Load) -> None:
    schema = load({"a.proto": 'syntax = "proto3";\nmessage A { bool z = 9; bool a = 1; bool m = 5; }'})
    assert [field.name for field in schema.messages["A"].fields] == ["z", "a", "m"]


def test_presence_is_that_of_optional_oneof_and_message_fields(load: Load) -> None:
    schema = load(
        {
            "a.proto": 'syntax = "proto3";\nmessage A {\n'
            "  int32 plain = 1;\n  optional int32 maybe = 2;\n  A nested = 3;\n"
            "  oneof choice { int32 one = 4; }\n  repeated int32 many = 5;\n}"
        }
    )
    presence = {field.name: field.has_presence for field in schema.messages["A"].fields}
    assert presence == {"plain": False, "maybe": True, "nested": True, "one": True, "many": False}


def test_enum_knows_names_aliases_and_negative_values(load: Load) -> None:
    schema = load(
        {
            "a.proto": 'syntax = "proto3";\nenum E { option allow_alias = true; A = 0; B = 0; C = -3; }\n'
            "message M { E e = 1; }"
        }
    )
    declared = Enum("E", (("A", 0), ("B", 0), ("C", -3)))
    assert schema.enums == {"E": declared}
    assert schema.messages["M"].fields[0].type == declared


def test_nested_types_have_full_names(load: Load) -> None:
    schema = load(
        {"a.proto": 'syntax = "proto3";\npackage p;\nmessage A { message B { enum C { X = 0; } C c = 1; } B b = 1; }'}
    )
    assert list(schema.messages) == ["p.A", "p.A.B", "Envelope"]
    assert list(schema.enums) == ["p.A.B.C"]
    assert schema.messages["p.A"].fields[0].type is schema.messages["p.A.B"]


def test_message_may_contain_itself(load: Load) -> None:
    schema = load({"a.proto": 'syntax = "proto3";\nmessage A { A a = 1; repeated B b = 2; }\nmessage B { A a = 1; }'})
    a = schema.messages["A"]
    assert a.fields[0].type is a
    assert a.fields[1].type == List(schema.messages["B"])


def test_map_is_a_list_of_its_entries(load: Load) -> None:
    schema = load({"a.proto": 'syntax = "proto3";\nmessage A { map<string, float> m = 1; }'})
    entry = schema.messages["A.MEntry"]
    assert schema.messages["A"].fields[0].type == List(entry)
    assert [(field.name, field.type) for field in entry.fields] == [("key", String()), ("value", Float(32))]


def test_proto2_with_required_groups_and_extensions(load: Load) -> None:
    schema = load(
        {
            "a.proto": 'syntax = "proto2";\nmessage A {\n  required int32 x = 1;\n'
            "  repeated group Part = 2 { optional bool y = 1; }\n  extensions 100 to 200;\n}\n"
            "extend A { optional int32 more = 100; }\n"
        }
    )
    x, part = schema.messages["A"].fields
    assert (x.type, x.has_presence) == (I32, True)
    assert (part.name, part.type) == ("part", List(schema.messages["A.Part"]))


def test_well_known_types_can_be_imported(load: Load) -> None:
    schema = load(
        {
            "a.proto": 'syntax = "proto3";\nimport "google/protobuf/timestamp.proto";\n'
            "message A { google.protobuf.Timestamp at = 1; }"
        }
    )
    stamp = schema.messages["google.protobuf.Timestamp"]
    assert schema.messages["A"].fields[0].type is stamp
    assert [(field.name, field.type) for field in stamp.fields] == [("seconds", I64), ("nanos", I32)]


def test_comments_above_and_beside_a_field_are_one_line(load: Load) -> None:
    schema = load(
        {
            "a.proto": 'syntax = "proto3";\nmessage A {\n  // Acceleration,\n  // all axes.\n'
            "  float x = 1;  // m/s^2\n  float y = 2;\n}"
        }
    )
    assert [field.comment for field in schema.messages["A"].fields] == ["Acceleration, all axes. m/s^2", ""]


def test_options_of_the_boards_are_bounds(load: Load) -> None:
    schema = load(
        {
            "a.proto": 'syntax = "proto3";\nmessage A {\n  string s = 1; string t = 2; bytes b = 3;\n'
            "  repeated float r = 4; repeated float f = 5; repeated string l = 6; string free = 7;\n}",
            "a.options": "A.s max_size:16\nA.t max_length:16\nA.b max_size:16\nA.r max_count:3\n"
            "A.f max_count:3 fixed_count:true\nA.l max_count:2 max_size:8\n",
        }
    )
    assert {field.name: field.type for field in schema.messages["A"].fields} == {
        "s": String(15),
        "t": String(16),
        "b": Bytes(16),
        "r": List(Float(32), bound=3),
        "f": List(Float(32), length=3),
        "l": List(String(7), bound=2),
        "free": String(),
    }
