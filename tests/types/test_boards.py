"""Payloads that a board with structures of a fixed size cannot take."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from router.errors import Code, SourceSpan
from router.types.boards import board_findings
from router.types.protobuf import Envelope, ProtoSchema

Load = Callable[[Mapping[str, str]], ProtoSchema]
Find = Callable[[ProtoSchema], Envelope]

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


def test_each_field_without_a_bound_is_a_finding_with_its_path(load: Load, envelope: Find) -> None:
    schema = load({"parts.proto": PROTO})
    findings = board_findings(envelope(schema).cases["parts"], schema, 1000, SPAN)
    assert [str(finding) for finding in findings] == [
        f"table.yaml:9:5: error[board-payload]: a board cannot take {path}: it {why}; "
        f"see parts.proto:{place}; bound it in an .options file beside the .proto, as nanopb does"
        for path, why, place in [
            ("parts.first.name", "is a string without a max_size", "3:10"),
            ("parts.first.values", "is repeated without a max_count", "4:18"),
            ("parts.raw", "is bytes without a max_size", "8:9"),
        ]
    ]


def test_bounded_payload_is_measured_with_its_envelope(load: Load, envelope: Find) -> None:
    options = "Part.name max_size:16\nPart.values max_count:4\nParts.raw max_size:8"
    schema = load({"parts.proto": PROTO, "parts.options": options})
    case = envelope(schema).cases["parts"]
    size = envelope(schema).max_size
    assert case.max_size == 2 + (2 + 15) + 4 * 5 + (2 + 8) == size - 2
    assert board_findings(case, schema, size, SPAN) == []
    (finding,) = board_findings(case, schema, size - 1, SPAN)
    assert (finding.code, finding.span) == (Code.BOARD_PAYLOAD, SPAN)
    assert f"takes up to {size} bytes; boards reject more than {size - 1}" in finding.message


def test_field_held_by_callback_and_recursion_are_findings(load: Load, envelope: Find) -> None:
    text = PROTO.replace("  repeated float values = 2;\n", "  Parts more = 2;\n")
    schema = load({"parts.proto": text, "parts.options": "Part.name max_size:3\nParts.raw max_size:3 type:FT_CALLBACK"})
    findings = board_findings(envelope(schema).cases["parts"], schema, 1000, SPAN)
    assert [finding.message for finding in findings] == [
        "a board cannot take parts.first.more: it contains itself",
        "a board cannot take parts.raw: it is held by pointer or callback",
    ]


def test_boards_can_take_every_case_of_the_rover(rover_schema: ProtoSchema, rover_envelope: Envelope) -> None:
    for case in rover_envelope.cases.values():
        assert board_findings(case, rover_schema, rover_envelope.max_size, SPAN) == []
