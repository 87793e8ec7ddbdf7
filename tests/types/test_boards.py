"""What boards can hold: sizes as nanopb computes them."""

from __future__ import annotations

import re
from pathlib import Path

from router.errors import Code, SourceSpan
from router.types.boards import board_findings, largest_encoding
from router.types.protobuf import Envelope, ProtoSchema, find_envelope, load_protos
from tests.tables import PROTOS
from tests.types.conftest import ONEOF, Load, Write, nanopb_headers, settings, with_envelope

_SIZE = re.compile(r"^#define (\w+)_size\s+(\d+)$", re.MULTILINE)


def nanopb_sizes(root: Path, output: Path) -> dict[str, int]:
    """Every `*_size` macro with a known value, by message."""
    return {name: int(size) for name, size in _SIZE.findall(nanopb_headers(root, output))}


def our_sizes(schema: ProtoSchema) -> dict[str, int]:
    sizes = {
        name.replace(".", "_"): largest_encoding(schema.descriptor(name), schema.board_options)
        for name in schema.messages
        if schema.sources.file(name) in schema.files
    }
    return {name: size for name, size in sizes.items() if size is not None}


def test_the_rovers_messages_are_as_large_as_nanopb_says(
    rover_schema: ProtoSchema, rover_envelope: Envelope, tmp_path: Path
) -> None:
    expected = nanopb_sizes(PROTOS, tmp_path)
    assert our_sizes(rover_schema) == expected
    assert rover_envelope.max_size == expected["PBEnvelope"]


def test_every_kind_of_field_is_as_large_as_nanopb_says(write: Write, tmp_path: Path) -> None:
    root = write(
        {
            "p/every.proto": 'syntax = "proto3";\n'
            "enum Small { S0 = 0; S1 = 127; }\n"
            "enum Large { L0 = 0; L1 = 128; L2 = 70000; }\n"
            "enum Negative { N0 = 0; N1 = -1; }\n"
            "message Scalars {\n"
            "  bool a = 1; float b = 2; double c = 3; int32 d = 4; int64 e = 5; uint32 f = 6; uint64 g = 7;\n"
            "  sint32 h = 8; sint64 i = 9; fixed32 j = 10; fixed64 k = 11; sfixed32 l = 12; sfixed64 m = 13;\n"
            "  Small n = 14; Large o = 15; Negative p = 16; optional int32 q = 17; float r = 3000; float s = 300000;\n"
            "}\n"
            "message Choice { oneof c { Scalars s = 1; bool flag = 2; } oneof d { double x = 3; float y = 4; } }\n"
            "message Empty {}\n"
            "message Bounded {\n"
            "  string s = 1; string t = 2; bytes b = 3; bytes fixed = 4; string long_text = 5;\n"
            "  repeated int32 r = 6; repeated Choice c = 7; repeated float one = 8; repeated uint32 fixed_count = 9;\n"
            "  repeated string texts = 10; Empty empty = 11; optional string maybe = 12;\n"
            "}\n"
            "message Outer { Bounded bounded = 1; message Inner { string name = 1; } Inner inner = 2; }\n"
            "message Unbounded { repeated float values = 1; }\n"
            "message Pointed { string s = 1; }\n"
            "message Wild { string first_name = 1; string last_name = 2; bytes other = 3; }\n",
            "p/every.options": "# as nanopb reads it\n"
            "Bounded.s max_size:16 // with its NUL\n"
            "Bounded.t  max_length:16, max_size:3\n"
            "Bounded.b\tmax_size:127\n"
            "Bounded.fixed max_size:128 fixed_length:true\n"
            "Bounded.long_text max_size:129\n"
            "Bounded.r max_count:5\n"
            "Bounded.c max_count:2 /* two */\n"
            "Bounded.one max_count:1\n"
            "Bounded.fixed_count max_count:4 fixed_count:true\n"
            "Bounded.texts max_count:3 max_size:8\n"
            "Bounded.maybe max_size:4; type:FT_STATIC\n"
            "Outer.Inner.* max_size:40\n"
            "Pointed.s max_size:8 type:FT_POINTER\n"
            "Wild max_size:9\n"
            "Wild.*_name max_length:20\n"
            "*.last_name max_length:30 long_names:false\n",
        }
    )
    assert our_sizes(load_protos(*settings(with_envelope(root)))) == nanopb_sizes(root, tmp_path / "out")


def test_message_inside_itself_has_no_largest_encoding(load: Load) -> None:
    schema = load({"a.proto": 'syntax = "proto3";\nmessage A { B b = 1; }\nmessage B { A a = 1; }'})
    assert largest_encoding(schema.descriptor("A"), schema.board_options) is None


PROTO = """\
syntax = "proto3";
message Part {
  string name = 1;
  repeated float values = 2;
}
message Parts {
  Part first = 1;
  bytes raw = 2;
}
message Envelope {
  oneof payload {
    Parts parts = 1;
  }
}
"""
SPAN = SourceSpan("table.yaml", 9, 5, 14)


def test_bounded_payload_is_measured_with_its_envelope(load: Load) -> None:
    options = "Part.name max_size:16\nPart.values max_count:4\nParts.raw max_size:8"
    schema = load({"parts.proto": PROTO, "parts.options": options})
    envelope = find_envelope(schema, ONEOF)
    case, size = envelope.cases["parts"], envelope.max_size
    assert case.max_size == 2 + (2 + 15) + 4 * 5 + (2 + 8) == size - 2
    assert board_findings(case, schema, size, SPAN) == []
    (finding,) = board_findings(case, schema, size - 1, SPAN)
    assert (finding.code, finding.span) == (Code.BOARD_PAYLOAD, SPAN)
    assert f"takes up to {size} bytes; boards reject more than {size - 1}" in finding.message


def test_field_held_by_callback_and_recursion_are_findings(load: Load) -> None:
    text = PROTO.replace("  repeated float values = 2;\n", "  Parts more = 2;\n")
    schema = load({"parts.proto": text, "parts.options": "Part.name max_size:3\nParts.raw max_size:3 type:FT_CALLBACK"})
    findings = board_findings(find_envelope(schema, ONEOF).cases["parts"], schema, 1000, SPAN)
    assert [finding.message for finding in findings] == [
        "a board cannot decode parts.first.more: it contains itself",
        "a board cannot decode parts.raw: it is stored by pointer or callback",
    ]
