"""Protobuf declarations as the type model: the envelope, its cases, every kind of field."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest

from router.compiler.lookup import Definitions
from router.errors import Code, Located, SourceSpan, TableError
from router.table.model.settings import EnvelopeSettings
from router.types.lock_file import LOCK_NAME, Declaration, Lock, write_lock
from router.types.model import Bytes, Enum, Float, Int, List, MessageType, String
from router.types.protobuf import Envelope, find_envelope, load_protos
from tests.types.conftest import ONEOF, Load, Refused, Write, refusal, settings

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


def test_packages_may_have_messages_of_one_name(load: Load) -> None:
    schema = load(
        {
            "a.proto": 'syntax = "proto3"; package a; message Motor { float x = 1; }',
            "b.proto": 'syntax = "proto3"; package b; import "a.proto"; message Motor { a.Motor motor = 1; }',
            "c.proto": 'syntax = "proto3"; import "b.proto"; import "a.proto";\n'
            "message Envelope { oneof payload { a.Motor first = 1; b.Motor second = 2; } }",
        }
    )
    cases = find_envelope(schema, ONEOF).cases
    assert [case.type.name for case in cases.values()] == ["a.Motor", "b.Motor"]


def test_members_of_the_oneof_that_are_no_messages_are_no_cases(load: Load) -> None:
    members = "Imu imu = 1; sfixed64 stamp = 2; string name = 3; bytes raw = 400;"
    schema = load(
        {"a.proto": f'syntax = "proto3"; message Imu {{}} message Envelope {{ oneof payload {{ {members} }} }}'}
    )
    found = find_envelope(schema, ONEOF)
    assert [*found.cases] == ["imu"]
    assert {name: (each.number, each.type) for name, each in found.unroutable.items()} == {
        "stamp": (2, "sfixed64"),
        "name": (3, "string"),
        "raw": (400, "bytes"),
    }
    assert found.max_size == 9, "the largest member with a bound"


@pytest.mark.parametrize("number", [18999, 20000])
def test_numbers_beside_those_of_the_protobuf_library_are_free(load: Load, number: int) -> None:
    assert load({"a.proto": f'syntax = "proto3"; message A {{ float x = {number}; }}'}).messages["A"].fields


@pytest.mark.parametrize(
    "text",
    [
        'syntax = "proto3"; message A {\n float x = 19000; }',
        'syntax = "proto3"; message A { message B {\n float x = 19999; } }',
        'syntax = "proto2"; message A { extensions 10 to max; }\n extend A { optional int32 x = 19500; }',
        'syntax = "proto2"; message A { extensions 10 to max; extend A {\n optional int32 x = 19500; } }',
    ],
)
def test_numbers_of_the_protobuf_library_are_refused(refused: Refused, text: str) -> None:
    (finding,) = refused({"a.proto": text})
    assert (finding.code, finding.span.file, finding.span.line) == (Code.BAD_PROTO, "a.proto", 2)
    assert finding.message.endswith("are reserved for the protocol buffer library implementation")


def test_hash_changes_with_content_and_name_of_protos_and_options(load: Load) -> None:
    first = load({"a.proto": 'syntax = "proto3";'}).sha256
    assert load({"a.proto": 'syntax = "proto3";'}).sha256 == first
    with_options = load({"a.options": "A.x max_size:3"}).sha256
    assert load({"a.proto": 'syntax = "proto3"; '}).sha256 not in {first, with_options}
    assert with_options != first


def test_message_class_has_a_pool_of_its_own(write: Write) -> None:
    root = write({"a.proto": ENVELOPE})
    first, second = load_protos(*settings(root)), load_protos(*settings(root))
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
    found = find_envelope(load({"a.proto": ENVELOPE}), ONEOF)
    imu, note = found.cases["imu"], found.cases["note"]
    assert (imu.number, imu.type.name, imu.max_size) == (13, "Imu", 5)
    assert (note.number, note.type.name, note.max_size) == (2, "Note", None)
    assert imu.message_class.DESCRIPTOR.full_name == "Imu"
    assert (found.name, found.choice.oneof, found.max_size) == ("Envelope", "payload", 7)


def test_envelope_size_counts_what_stands_beside_the_oneof(load: Load) -> None:
    text = ENVELOPE.replace("  oneof", "  uint32 timeout = 30;\n  repeated int32 more = 31;\n  oneof")
    assert find_envelope(load({"a.proto": text}), ONEOF).max_size == 7 + 2 + 5


def test_envelope_in_a_package_is_found_by_short_name(write: Write) -> None:
    root = write({"a.proto": ENVELOPE.replace("message Imu", "package rover;\nmessage Imu")})
    assert load_protos(*settings(root)).envelope == "rover.Envelope"
    assert load_protos(*settings(root, "rover.Envelope")).envelope == "rover.Envelope"


@pytest.mark.parametrize(
    ("message", "oneof", "finding"),
    [
        (
            "Envelope", "paylod",
            "table.yaml:4:10: error[bad-value]: Envelope has no oneof 'paylod'; did you mean 'payload'?",
        ),
        ("Imu", "payload", ("table.yaml:4:10: error[bad-value]: Imu has no oneof 'payload'; "
         "Envelope has it: write `message: Envelope` if that is the envelope")),
    ],
)  # fmt: skip
def test_wrong_name_in_the_table_is_a_finding_there(write: Write, message: str, oneof: str, finding: str) -> None:
    named = settings(write({"a.proto": ENVELOPE}), message)
    with pytest.raises(TableError) as caught:
        find_envelope(load_protos(*named), replace(ONEOF, value=oneof))
    assert [str(found) for found in caught.value.diagnostics] == [finding]


def test_the_rovers_envelope_has_the_26_cases_of_the_existing_system(rover_envelope: Envelope) -> None:
    assert {case.number for case in rover_envelope.cases.values()} >= set(range(1, 27))


STRAY = {
    "does not compile": ("message A { int32 x = 1 }", 'b.proto:2:25: warning[unused-proto]: {}: Expected ";"'),
    "imports what is not there": (
        'import "nowhere";',
        (
            "b.proto:2:1: warning[unused-proto]: {}: there is no file 'nowhere' to import; "
            "copy it into ., the folder that imports are relative to"
        ),
    ),
    "has a message of the same name": (
        "message Imu {}",
        'b.proto:2:9: warning[unused-proto]: {}: "Imu" is already defined in file "a.proto"',
    ),
    "has the envelope once more": (
        "// message PBEnvelope\nmessage Old {\n  message Envelope {}\n}\nmessage Imu {}",
        'b.proto:6:9: warning[unused-proto]: {}: "Imu" is already defined in file "a.proto"',
    ),
    "has many faults": (
        "message Imu { float x = 1; }\nmessage Note {}\n",
        'b.proto:2:9: warning[unused-proto]: {}: "Imu" is already defined in file "a.proto" (and 1 more)',
    ),
}


@pytest.mark.parametrize(("stray", "warning"), STRAY.values(), ids=STRAY.keys())
def test_file_that_the_envelope_does_not_import_is_a_warning(write: Write, stray: str, warning: str) -> None:
    schema = load_protos(*settings(write({"a.proto": ENVELOPE, "b.proto": f'syntax = "proto3";\n{stray}'})))
    said = "the envelope does not use this file, so it is left out"
    (found,) = schema.warnings
    hint, _, otherwise = found.hint.partition("; or, ")
    assert str(replace(found, hint=hint.removesuffix("repair it"))) == warning.format(said)
    assert otherwise == "if it is not yours, write `exclude: [b.proto]` in the table's `envelope`"
    assert schema.files == ("a.proto",)
    assert list(schema.messages) == ["Imu", "Note", "Envelope"]


def excluding(*names: str) -> tuple[Located[str], ...]:
    return tuple(Located(name, SourceSpan("table.yaml", 5, 12)) for name in names)


def test_excluded_files_and_folders_are_as_if_they_were_not_there(write: Write) -> None:
    root = write(
        {
            "a.proto": ENVELOPE,
            "old/b.proto": "message B {}",
            "old/b.options": "B.x nonsense",
            "older.proto": 'syntax = "proto3";\nmessage Envelope {}',
            "user.proto": 'syntax = "proto3";\nimport "old/b.proto";\nmessage User {}',
            "tests/c.proto": 'syntax = "proto3";\nmessage Imu {}',
            "gr\u00f6\u00dfe.proto": "",
        }
    )
    exclude = excluding("old/b.proto", "older.proto", "tests/", "gr\u00f6\u00dfe.proto")
    schema = load_protos(*settings(root), exclude=exclude, with_others=True)
    assert (schema.files, schema.warnings) == (("a.proto",), ())


@pytest.mark.parametrize(
    ("excluded", "code", "line", "message", "hint"),
    [
        (
            "imu.proto", Code.BAD_VALUE, 5, "'imu.proto' cannot be excluded: the envelope Envelope needs imu.proto",
            "exclude only what the envelope does not import",
        ),
        (
            "a.proto", Code.BAD_VALUE, 3, "no .proto file declares a message 'Envelope'",
            "is it in a file that `exclude` leaves out (a.proto)?",
        ),
        ("b.proto", Code.BAD_FILE, 5, ". has no file or folder 'b.proto' to exclude", "did you mean 'c/b.proto'?"),
    ],
)  # fmt: skip
def test_exclude_names_files_that_are_there_and_not_needed(
    write: Write, excluded: str, code: Code, line: int, message: str, hint: str
) -> None:
    root = write(
        {
            "a.proto": ENVELOPE.replace("message Imu { float x = 1; }", 'import "imu.proto";'),
            "imu.proto": 'syntax = "proto3";\nmessage Imu { float x = 1; }',
            "c/b.proto": 'syntax = "proto3";\nmessage B {}',
        }
    )
    with pytest.raises(TableError) as caught:
        load_protos(*settings(root), exclude=excluding(excluded))
    (found,) = caught.value.diagnostics
    assert (found.code, found.span.line, found.message, found.hint) == (code, line, message, hint)


def test_protos_are_read_again_once_something_else_is_excluded(write: Write) -> None:
    protos, message, *_ = settings(write({"a.proto": ENVELOPE, "b.proto": "message B {}"}))
    whole = EnvelopeSettings(protos, message, ONEOF)
    known = Definitions().protos(whole)
    assert Definitions([known]).protos(whole) is known
    assert Definitions([known]).protos(replace(whole, exclude=excluding("b.proto"))).warnings == ()


def test_stray_files_that_cannot_be_read_and_their_options_are_warnings(write: Write) -> None:
    root = write(
        {"a.proto": ENVELOPE, "b.proto": "message B {}", "b.options": "B.x nonsense", "gr\u00f6\u00dfe.proto": ""}
    )
    (root / "c.proto").write_bytes(b'syntax = "proto3"; // gr\xf6sse')
    (root / "d.proto").symlink_to("nowhere.proto")
    warnings = load_protos(*settings(root)).warnings
    assert {(found.span.file, found.code) for found in warnings} == {
        (name, Code.UNUSED_PROTO) for name in ("b.proto", "b.options", "c.proto", "d.proto", "table.yaml")
    }


def test_enum_of_the_envelopes_name_is_none(write: Write) -> None:
    enum = 'syntax = "proto3";\nenum Envelope {\n  E_NONE = 0;\n}\n'
    schema = load_protos(*settings(write({"a.proto": ENVELOPE, "b.proto": enum})))
    assert [(found.span.file, found.code) for found in schema.warnings] == [("b.proto", Code.UNUSED_PROTO)]
    (finding, *_) = refusal(write({"a.proto": enum, "b.proto": 'syntax = "proto3"; message Imu {}'}))
    assert finding.message == "no .proto file declares a message 'Envelope'"


def test_file_name_that_is_not_utf8_is_a_warning(write: Write) -> None:
    root = write({"a.proto": ENVELOPE})
    Path(os.fsdecode(os.fsencode(root) + b"/caf\xe9.proto")).write_text('syntax = "proto3";')
    schema = load_protos(*settings(root))
    assert [found.code for found in schema.warnings] == [Code.UNUSED_PROTO]
    assert len(schema.sha256) == 64


@pytest.mark.parametrize(
    "first", ["\ufeffsyntax", "/* licence\n */ syntax", "// licence\n\n  syntax", "/* a */\n/* syntax = */\tsyntax"]
)
def test_syntax_may_stand_after_comments(write: Write, first: str) -> None:
    assert load_protos(*settings(write({"a.proto": ENVELOPE.replace("syntax", first, 1)}))).warnings == ()


@pytest.mark.parametrize("linked", ["linked", ".hidden"])
def test_imported_files_are_the_folders_own_wherever_they_are(write: Write, tmp_path: Path, linked: str) -> None:
    """In a folder that is a link to a submodule, say."""
    files = {
        "rover/a.proto": ENVELOPE.replace("message Imu { float x = 1; }", f'import "{linked}/imu.proto";'),
        "other/imu.proto": 'syntax = "proto3"; message Imu { float x = 1; }',
    }
    root = write(files) / "rover"
    (root / linked).symlink_to(tmp_path / "other")
    (root / "again").symlink_to(root)
    schema = load_protos(*settings(root))
    assert schema.files == (f"{linked}/imu.proto", "a.proto")
    assert schema.span("Imu").file == f"rover/{linked}/imu.proto"


def test_stray_file_without_a_fault_can_be_compiled_too(write: Write) -> None:
    files = {
        "a.proto": ENVELOPE,
        "b.proto": 'syntax = "proto3"; message B {}',
        "c.proto": 'syntax = "proto3"; import "d.proto"; message C {}',
        "d.proto": "message D",
    }
    schema = load_protos(*settings(write(files)), with_others=True)
    assert set(schema.messages) == {"Imu", "Note", "Envelope", "B"}
    assert [found.span.file for found in schema.warnings] == ["d.proto"]


@pytest.mark.parametrize(
    ("copy", "message", "lock", "chosen"),
    [
        ("", "Envelope", None, None),
        ("", "Envelope", "b.proto", "b.proto"),
        ("package old;", "Envelope", None, "a.proto"),
        ("package old;", "Envelope", "a.proto", "a.proto"),
        ("package old;", "old.Envelope", None, "b.proto"),
    ],
)
def test_of_two_files_that_declare_the_envelope_the_locked_one_counts(
    write: Write, copy: str, message: str, lock: str | None, chosen: str | None
) -> None:
    root = write({"a.proto": ENVELOPE, "b.proto": ENVELOPE.replace(";\n", f";\n{copy}\n", 1)})
    if lock is not None:
        declared = Declaration(lock, frozenset())
        write_lock(root / LOCK_NAME, Lock("Envelope", "payload", 7, {"Envelope": declared}, {}))
    if chosen is not None:
        schema = load_protos(*settings(root, message))
        assert schema.sources.file(schema.envelope) == chosen
        return
    (finding,) = refusal(root, message)
    assert str(finding) == (
        "table.yaml:3:12: error[duplicate-message]: several files declare a message 'Envelope': a.proto and b.proto; "
        "remove all but one, or write the full name if they have packages"
    )


DEEP = {
    "rover/common/envelope.proto": ENVELOPE.replace("message Imu", 'import "rover/imu/imu.proto";\nmessage Old'),
    "rover/imu/imu.proto": 'syntax = "proto3"; import "rover/imu/axis.proto"; message Imu { Axis x = 1; }',
    "rover/imu/axis.proto": 'syntax = "proto3"; message Axis {}',
}


@pytest.mark.parametrize(
    ("folder", "said"),
    [
        ("protos/rover", "`protos` is one folder too deep: common/envelope.proto imports 'rover/imu/imu.proto'; use"),
        ("protos/rover/common", "`protos` is two folders too deep: envelope.proto imports 'rover/imu/imu.proto'; use"),
        ("protos/rover/imu", "`protos` is two folders too deep: imu.proto imports 'rover/imu/axis.proto'; use"),
    ],
)
def test_wrong_folder_of_protos_is_said_to_be_it(write: Write, folder: str, said: str) -> None:
    root = write({f"protos/{name}": text for name, text in DEEP.items()})
    (finding,) = refusal(root / folder)
    assert (finding.code, finding.span.line) == (Code.BAD_VALUE, 2)
    assert f"{finding.message}; {finding.hint}".startswith(f"{said} protos, because imports are relative to it")
    load_protos(*settings(root / "protos"))


def test_folder_whose_imports_are_elsewhere_in_it_is_the_right_one(refused: Refused) -> None:
    """`protos/rover` has all that the envelope imports, but not what that imports in its turn."""
    files = {name: text for name, text in DEEP.items() if "axis" not in name}
    (finding,) = refused({f"protos/{name}": text for name, text in files.items()})
    assert finding.message == "there is no file 'rover/imu/imu.proto' to import"
    assert finding.hint == "did you mean 'protos/rover/imu/imu.proto'?"


TYPES = """\
syntax = "proto3";
package p;
import "google/protobuf/timestamp.proto";
enum E { option allow_alias = true; A = 0; B = 0; C = -3; }
message Scalars {
  bool z = 19; float a = 2; double b = 3; string c = 4; bytes d = 5;
  int32 e = 6; sint32 f = 7; sfixed32 g = 8; uint32 h = 9; fixed32 i = 10;
  int64 j = 11; sint64 k = 12; sfixed64 l = 13; uint64 m = 14; fixed64 n = 15;
}
message Kinds {
  // Acceleration,
  // all axes.
  float plain = 1;  // m/s^2
  optional int32 maybe = 2;
  Kinds itself = 3;
  oneof choice { E one = 4; }
  repeated float many = 5;
  map<string, float> pairs = 6;
  google.protobuf.Timestamp at = 7;
  message Inner { enum Mode { X = 0; } Mode mode = 1; }
  repeated Inner inner = 8;
}
"""


def listed(message: MessageType) -> list[str]:
    """The fields in their declared order."""
    return [
        f"{field.name} = {field.number}: {field.type}"
        + " with presence" * field.has_presence
        + " required" * field.is_required
        + (f" in {field.oneof}" if field.oneof else "")
        + (f"  # {field.comment}" if field.comment else "")
        for field in message.fields
    ]


def test_every_kind_of_field_has_its_type(load: Load) -> None:
    schema = load({"a.proto": TYPES})
    ours = {name: message for name, message in schema.messages.items() if name.startswith("p.")}
    assert {name: listed(message) for name, message in ours.items()} == {
        "p.Scalars": [
            "z = 19: bool", "a = 2: float32", "b = 3: float64", "c = 4: string", "d = 5: bytes", "e = 6: int32",
            "f = 7: int32", "g = 8: int32", "h = 9: uint32", "i = 10: uint32", "j = 11: int64", "k = 12: int64",
            "l = 13: int64", "m = 14: uint64", "n = 15: uint64",
        ],
        "p.Kinds": [
            "plain = 1: float32  # Acceleration, all axes. m/s^2",
            "maybe = 2: int32 with presence in _maybe",
            "itself = 3: p.Kinds with presence",
            "one = 4: p.E with presence in choice",
            "many = 5: float32[]",
            "pairs = 6: p.Kinds.PairsEntry[]",
            "at = 7: google.protobuf.Timestamp with presence",
            "inner = 8: p.Kinds.Inner[]",
        ],
        "p.Kinds.PairsEntry": ["key = 1: string required", "value = 2: float32 required"],
        "p.Kinds.Inner": ["mode = 1: p.Kinds.Inner.Mode"],
    }  # fmt: skip
    assert list(schema.messages) == ["google.protobuf.Timestamp", *ours, "Envelope"]
    assert schema.enums["p.E"] == Enum("p.E", (("A", 0), ("B", 0), ("C", -3)))
    assert list(schema.enums) == ["p.E", "p.Kinds.Inner.Mode"]
    kinds = schema.messages["p.Kinds"]
    assert kinds.fields[2].type is kinds, "a name has one type"
    stamp = schema.messages["google.protobuf.Timestamp"]
    assert [(field.name, str(field.type)) for field in stamp.fields] == [("seconds", "int64"), ("nanos", "int32")]


def test_proto2_with_required_groups_and_extensions(load: Load) -> None:
    schema = load(
        {
            "a.proto": 'syntax = "proto2";\nmessage A {\n  required int32 x = 1;\n'
            "  repeated group Part = 2 { optional bool y = 1; }\n  extensions 100 to 200;\n}\n"
            "extend A { optional int32 more = 100; }\n"
        }
    )
    x, part = schema.messages["A"].fields
    assert (x.type, x.has_presence, x.is_required) == (Int(32, True), True, True)
    assert (part.name, part.type) == ("part", List(schema.messages["A.Part"]))


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
