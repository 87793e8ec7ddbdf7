"""The folder of `.proto` files as a schema, and the envelope in it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from router.errors import Code, Diagnostic, SourceSpan, TableError
from router.types.protobuf import Envelope, ProtoSchema, find_envelope, load_protos
from tests.types.conftest import settings

Write = Callable[[Mapping[str, str]], Path]
Load = Callable[[Mapping[str, str]], ProtoSchema]
Refused = Callable[[Mapping[str, str]], tuple[Diagnostic, ...]]

ENVELOPE = """\
syntax = "proto3";
message Imu { float x = 1; }
message Note { string text = 1; }
message Envelope {
  oneof payload {
    Imu imu = 13;
    Note note = 2;
  }
}
"""


def test_one_short_name_in_two_packages_is_blamed_on_the_second(refused: Refused) -> None:
    (finding,) = refused(
        {
            "a.proto": 'syntax = "proto3";\npackage a;\nmessage Motor {}',
            "b.proto": 'syntax = "proto3";\npackage b;\n\nmessage Motor {}',
        }
    )
    assert (finding.code, finding.span) == (Code.DUPLICATE_MESSAGE, SourceSpan("b.proto", 4, 9, 14))
    assert "a.proto:3" in finding.hint


def test_hash_changes_with_content_and_name_of_protos_and_options(load: Load) -> None:
    first = load({"a.proto": 'syntax = "proto3";'}).sha256
    assert load({"a.proto": 'syntax = "proto3";'}).sha256 == first
    with_options = load({"a.options": "A.x max_size:3"}).sha256
    assert load({"a.proto": 'syntax = "proto3"; '}).sha256 not in {first, with_options}
    assert with_options != first


def test_message_class_has_a_pool_of_its_own(write: Write) -> None:
    root = write({"a.proto": ENVELOPE})
    first, second = load_protos(settings(root)), load_protos(settings(root))
    message = first.message_class("Imu")(x=1.5)
    assert second.message_class("Imu").FromString(message.SerializeToString()) != message
    assert second.message_class("Imu") is not first.message_class("Imu")


def test_span_finds_messages_fields_enums_and_values(load: Load) -> None:
    schema = load(
        {
            "a.proto": 'syntax = "proto3";\n'
            "message A {\n"
            "  enum State { IDLE = 0; }\n"
            "  State state = 1;\n"
            "  map<string, int32> counts = 2;\n"
            "}\n"
        }
    )
    assert schema.span("A") == SourceSpan("a.proto", 2, 9, 10)
    assert schema.span("A.State") == SourceSpan("a.proto", 3, 8, 13)
    assert schema.span("A.State", "IDLE") == SourceSpan("a.proto", 3, 16, 20)
    assert schema.span("A", "state") == SourceSpan("a.proto", 4, 9, 14)
    assert schema.span("A.CountsEntry").line == 2, "what is written nowhere is blamed on what it is in"


def test_envelope_cases_have_number_type_class_and_size(load: Load) -> None:
    found = find_envelope(load({"a.proto": ENVELOPE}), settings(Path()))
    imu, note = found.cases["imu"], found.cases["note"]
    assert (imu.number, imu.type.name, imu.max_size) == (13, "Imu", 5)
    assert (note.number, note.type.name, note.max_size) == (2, "Note", None)
    assert imu.message_class.DESCRIPTOR.full_name == "Imu"
    assert (found.name, found.oneof, found.max_size) == ("Envelope", "payload", 7)


def test_envelope_size_counts_what_stands_beside_the_oneof(load: Load) -> None:
    text = ENVELOPE.replace("  oneof", "  uint32 timeout = 30;\n  repeated int32 more = 31;\n  oneof")
    assert find_envelope(load({"a.proto": text}), settings(Path())).max_size == 7 + 2 + 5


def test_envelope_in_a_package_is_found_by_short_name(write: Write) -> None:
    root = write({"a.proto": ENVELOPE.replace("message Imu", "package rover;\nmessage Imu")})
    assert load_protos(settings(root)).envelope == "rover.Envelope"
    assert load_protos(settings(root, "rover.Envelope")).envelope == "rover.Envelope"


@pytest.mark.parametrize(
    ("message", "oneof", "finding"),
    [
        (
            "Envelop", "payload",
            "table.yaml:3:12: error[bad-value]: no .proto file declares a message 'Envelop'; did you mean 'Envelope'?",
        ),
        (
            "Envelope", "paylod",
            "table.yaml:4:10: error[bad-value]: Envelope has no oneof 'paylod'; did you mean 'payload'?",
        ),
        ("Imu", "payload", "table.yaml:4:10: error[bad-value]: Imu has no oneof 'payload'"),
    ],
)  # fmt: skip
def test_wrong_name_in_the_table_is_a_finding_there(write: Write, message: str, oneof: str, finding: str) -> None:
    named = settings(write({"a.proto": ENVELOPE}), message, oneof)
    with pytest.raises(TableError) as caught:
        find_envelope(load_protos(named), named)
    assert [str(found) for found in caught.value.diagnostics] == [finding]


def test_payload_case_that_is_no_message_is_a_finding_in_the_proto(load: Load) -> None:
    schema = load({"a.proto": ENVELOPE.replace("Note note = 2", "uint32 timeout = 2")})
    with pytest.raises(TableError) as caught:
        find_envelope(schema, settings(Path()))
    (finding,) = caught.value.diagnostics
    assert (finding.code, finding.span) == (Code.BAD_PROTO, SourceSpan("a.proto", 7, 12, 19))


def test_the_rovers_envelope_has_the_26_cases_of_the_existing_system(rover_envelope: Envelope) -> None:
    assert {case.number for case in rover_envelope.cases.values()} >= set(range(1, 27))
