"""Every way to break the field numbers, and the lock file that notices. `history.yaml` has the exact texts of more."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.errors import Code, Diagnostic, TableError
from router.types.lock import LockComparison
from router.types.lock_file import LOCK_NAME, Declaration, Entry, Lock, read_lock, write_lock
from router.types.protobuf import find_envelope, load_protos
from tests.types.conftest import ONEOF, Write, settings

Compare = Callable[..., LockComparison]
Record = Callable[..., None]

PROTO = """\
syntax = "proto3";

enum State {
  IDLE = 0;
  BUSY = 1;
}

message Motor {
  float rpm = 1;
  State state = 2;
  float voltage = 3;
}

message Envelope {
  oneof payload {
    Motor motor = 1;
  }
}
"""


@pytest.fixture
def compare(write: Write) -> Compare:
    """Compare `motor.proto` of this text, or all files of the texts, with the lock."""

    def comparison(texts: str | Mapping[str, str], message: str = "Envelope") -> LockComparison:
        root = write({"motor.proto": texts} if isinstance(texts, str) else texts)
        schema = load_protos(*settings(root, message))
        return LockComparison(find_envelope(schema, ONEOF))

    return comparison


@pytest.fixture
def record(compare: Compare) -> Record:
    """Lock `motor.proto` of this text, or all files of the texts."""
    return lambda texts: write_lock(Path(LOCK_NAME), compare(texts).extended())


@pytest.fixture
def changed(record: Record, compare: Compare) -> Callable[..., list[Diagnostic]]:
    """Lock a text, replace a part of it by another, and compare."""

    def findings(old: str, new: str, text: str = PROTO) -> list[Diagnostic]:
        record(text)
        assert old in text
        return compare(text.replace(old, new)).findings()

    return findings


def said(findings: Sequence[Diagnostic]) -> list[str]:
    return [f"{finding.severity.value} {finding.message}" for finding in findings]


@pytest.mark.parametrize(
    ("old", "new", "finding"),
    [
        pytest.param(
            "State state = 2", "repeated State state = 2",
            "motor.proto:10:12: error[wire-number-conflict]: Motor.state is of type repeated enum State instead of "
            "enum State; restore `State state = 2` from the lock, or reserve 2 and add a field with a free number; "
            "if the change is intended, run `router schema lock --protos . --accept Motor.state`",
            id="repeated",
        ),
        pytest.param(
            "float rpm = 1", "float speed = 1",
            "motor.proto:9:17: error[wire-number-conflict]: number 1 of Motor belongs to 'rpm', not to 'speed'; "
            "restore `float rpm = 1` from the lock, or reserve 1 and use a free number; "
            "if the change is intended, run `router schema lock --protos . --accept Motor.speed`",
            id="renamed",
        ),
        pytest.param(
            "  BUSY = 1;\n", "",
            "motor.proto:3:6: error[wire-number-conflict]: number 1 of State, formerly 'BUSY', is not reserved; "
            "write `reserved 1;` there: the lock has `BUSY = 1`; "
            "if the change is intended, run `router schema lock --protos . --accept State.BUSY`",
            id="enum value removed",
        ),
    ],
)  # fmt: skip
def test_change_is_one_finding_at_its_line(
    changed: Callable[..., list[Diagnostic]], old: str, new: str, finding: str
) -> None:
    assert [str(found) for found in changed(old, new) if "takes up to" not in found.message] == [finding]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("  float rpm = 1;\n", "  reserved 1;\n"),
        ("  float rpm = 1;\n", "  reserved 1;\n  reserved 5 to 9;\n"),
        ("  BUSY = 1;\n", "  reserved 1;\n"),
        ("float rpm = 1;", "float rpm = 1;  // revolutions per minute"),
        ("  float rpm = 1;\n  State state = 2;\n", "  State state = 2;\n  float rpm = 1;\n"),
        ("float rpm", "optional float rpm"),
        ("  BUSY = 1;", "  BUSY = 0x1;"),
    ],
)
def test_change_that_keeps_the_wire_is_no_conflict(
    changed: Callable[..., list[Diagnostic]], old: str, new: str
) -> None:
    assert [found for found in changed(old, new) if found.code is Code.WIRE_NUMBER_CONFLICT] == []


def test_reserved_field_may_return_under_another_number(changed: Callable[..., list[Diagnostic]]) -> None:
    findings = changed("float rpm = 1;", "reserved 1;\n  double rpm = 4;")
    assert {found.code for found in findings} == {Code.NOT_LOCKED}


def test_number_stays_taken_after_its_reservation_is_gone(record: Record, compare: Compare) -> None:
    record(PROTO)
    record(PROTO.replace("float rpm = 1", "reserved 1"))
    (conflict,) = compare(PROTO.replace("float rpm = 1", "bool on = 1")).conflicts
    assert "belongs to 'float rpm'" in conflict.finding.message


@pytest.mark.parametrize(
    ("old", "reserved", "new", "error"),
    [
        ("float voltage = 3;", "reserved 7, 9 to 12;", "bool on = 10;", "number 10 of Motor is reserved, but"),
        ("BUSY = 1;", "reserved 5;", "DONE = 5;", "number 5 of State is reserved, but used for 'DONE'"),
    ],
)
def test_number_that_was_reserved_before_the_first_lock_stays_taken(
    record: Record, compare: Compare, old: str, reserved: str, new: str, error: str
) -> None:
    record(PROTO.replace(old, f"{old} {reserved}"))
    text = PROTO.replace(old, f"{old} {new}")
    comparison = compare(text)
    (conflict,) = comparison.conflicts
    assert conflict.finding.message.startswith(error)
    write_lock(Path(LOCK_NAME), comparison.extended([conflict]))
    assert compare(text).findings() == []


def test_enums_of_one_name_are_not_taken_for_each_other(record: Record, compare: Compare) -> None:
    """Package `pb` becomes `qb`, and what used the enum of `pa` uses its."""
    enum = 'syntax = "proto3"; package {0}; enum St {{ {0}0 = 0; {0}1 = 1; }} message M{0} {{ St s = 1; }}'
    uses = 'syntax = "proto3"; import "a.proto"; import "b.proto"; message Envelope { oneof payload { %s } } '
    cases = "pa.Mpa a = 1; %s.Mpb b = 2;"
    record({"a.proto": enum.format("pa"), "b.proto": enum.format("pb"), "e.proto": uses % (cases % "pb")})
    moved = enum.format("pb").replace("package pb", "package qb")
    gone = 'syntax = "proto3"; package pa; import "b.proto"; message Mpa { qb.St s = 1; }'
    comparison = compare({"a.proto": gone, "b.proto": moved, "e.proto": uses % (cases % "qb")})
    assert "pa.Mpa.s" in {conflict.name for conflict in comparison.conflicts}


def test_oneof_that_is_called_as_protoc_calls_its_own_is_a_oneof(changed: Callable[..., list[Diagnostic]]) -> None:
    findings = changed("float rpm = 1;", "oneof _rpm { float rpm = 1; }")
    assert [found.message for found in findings] == ["Motor.rpm has moved into the oneof '_rpm'"]


PACKAGE = ('syntax = "proto3";', 'syntax = "proto3";\npackage rover;')


@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        ("float rpm = 1", "double rpm = 1", "error rover.Motor.rpm is of type double instead of float"),
        ("BUSY = 1", "BUSY = 2", "error rover.State.BUSY has number 2 instead of 1"),
        ("Motor motor = 1", "Motor motor = 2", "error rover.Envelope.motor has number 2 instead of 1"),
        ("State state = 2", "int32 state = 2", "error rover.Motor.state is of type int32 instead of enum rover.State"),
    ],
)
def test_package_does_not_switch_the_lock_off(record: Record, compare: Compare, old: str, new: str, error: str) -> None:
    record(PROTO)
    assert error in said(compare(PROTO.replace(*PACKAGE).replace(old, new)).findings())


def test_lock_of_another_package_is_recorded_under_the_new_names(record: Record, compare: Compare) -> None:
    """And protects them, whatever package they had."""
    nested = PROTO.replace("message Motor {", "message Motor {\n  enum Mode { ON = 0; }\n  Mode mode = 9;")
    record(nested)
    record(nested.replace(*PACKAGE))
    text = Path(LOCK_NAME).read_text()
    assert json.loads(text)["messages"].keys() == {"rover.Motor", "rover.Envelope"}
    assert '"9": "enum rover.Motor.Mode mode"' in text
    record(nested)
    findings = compare(nested.replace("ON = 0", "OFF = 0")).findings()
    assert "error number 0 of Motor.Mode belongs to 'ON', not to 'OFF'" in said(findings)


MOTOR = """\
syntax = "proto3";
message Motor { %s }
message Envelope { oneof payload { Motor motor = 1; } }
"""


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            "oneof a { bool x = 1; bool y = 2; }", "oneof b { bool x = 1; bool y = 2; }",
            ["warning the lock records Motor.b under its old name Motor.a"],
        ),
        (
            "oneof a { bool x = 1; bool y = 2; }", "oneof b { bool x = 1; } oneof c { bool y = 2; }",
            ["error Motor.y has moved from the oneof 'b' to 'c'",
             "warning the lock records Motor.b under its old name Motor.a"],
        ),
        (
            "oneof a { bool x = 1; } oneof b { bool y = 2; }", "oneof c { bool x = 1; bool y = 2; }",
            ["error Motor.y has moved from the oneof 'b' to 'c'",
             "warning the lock records Motor.c under its old name Motor.a"],
        ),
        (
            "oneof a { bool x = 1; } oneof b { bool y = 2; }", "oneof b { bool x = 1; } oneof a { bool y = 2; }",
            ["error Motor.x has moved from the oneof 'a' to 'b'",
             "error Motor.y has moved from the oneof 'b' to 'a'"],
        ),
        (
            "oneof a { bool x = 1; } bool y = 2;", "bool x = 1; oneof a { bool y = 2; bool z = 3; }",
            ["error Motor.x has moved out of the oneof 'a'",
             "error Motor.y has moved into the oneof 'a'",
             "warning Motor.z is not in the lock"],
        ),
        ("bool x = 1;", "optional bool x = 1;", []),  # which protoc makes a oneof of
    ],
)  # fmt: skip
def test_oneof_may_have_another_name_but_no_other_members(
    changed: Callable[..., list[Diagnostic]], old: str, new: str, expected: list[str]
) -> None:
    findings = said(changed(old, new, MOTOR % old))
    assert sorted(text for text in findings if "takes up to" not in text) == expected


@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        ("[features.message_encoding = DELIMITED]", "", "error Motor.m is of type Motor instead of delimited Motor"),
        ("", "[features.message_encoding = DELIMITED]", "error Motor.m is of type delimited Motor instead of Motor"),
        (
            "[features.field_presence = LEGACY_REQUIRED]", "",
            "error Motor.m is of type Motor instead of required Motor",
        ),
    ],
)  # fmt: skip
def test_how_a_message_is_encoded_is_locked(
    changed: Callable[..., list[Diagnostic]], old: str, new: str, error: str
) -> None:
    proto = (MOTOR % f"Motor m = 1 {old};").replace('syntax = "proto3"', 'edition = "2023"')
    assert error in said(changed(f"m = 1 {old};", f"m = 1 {new};", proto))


def test_number_of_what_came_back_under_another_stays_taken(record: Record, compare: Compare) -> None:
    """`rpm` had number 1 and BUSY 1; both came back as 4, and then the old numbers are given away."""
    record(PROTO)
    back = PROTO.replace("float rpm = 1;", "reserved 1;\n  double rpm = 4;").replace(
        "BUSY = 1;", "reserved 1;\n  BUSY = 4;"
    )
    record(back)
    given = back.replace("reserved 1;\n  double", "bool on = 1;\n  double").replace("reserved 1;", "DONE = 1;")
    assert said(compare(given).findings()) == [
        "error number 1 of State belongs to 'BUSY', not to 'DONE'",
        "error number 1 of Motor belongs to 'float rpm', not to 'bool on'",
    ]
    assert said(compare(back.replace("reserved 1;", "")).findings()) == [
        "error number 1 of State, formerly 'BUSY', is not reserved",
        "error number 1 of Motor, formerly 'rpm', is not reserved",
    ]


def test_unresolved_merge_of_the_lock_says_so(record: Record, compare: Compare) -> None:
    record(PROTO)
    path = Path(LOCK_NAME)
    path.write_text(path.read_text().replace('        "2":', '<<<<<<< HEAD\n        "2":'))
    (finding,) = compare(PROTO).findings()
    assert str(finding) == (
        "envelope.lock.json:18:1: error[bad-file]: unresolved merge conflict; "
        "keep one side; `router validate` then says how to record what the other side had"
    )


def test_envelope_that_grows_says_so(changed: Callable[..., list[Diagnostic]]) -> None:
    findings = changed("float voltage = 3;", "float voltage = 3;\n  double energy = 4;")
    (finding,) = [found for found in findings if "bytes" in found.message]
    assert str(finding) == (
        "motor.proto:15:9: warning[not-locked]: Envelope takes up to 23 bytes; the lock says 14; "
        "flash the boards, then record it with `router schema lock --protos .`"
    )


def lock_text(**changes: object) -> str:
    envelope = {"message": "Envelope", "oneof": "payload", "max_size": 14}
    return json.dumps({"envelope": envelope, "messages": {}, "enums": {}, **changes})


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", 1),
        ("[]", 1),
        ("{}", 1),
        ('{\n  "envelope":\n<<<<<<< HEAD\n', 3),
        ('{"envelope": 1, "envelope": 2}', 1),
        (lock_text(envelope={"message": "E", "oneof": "o", "max_size": "many"}), 1),
        (lock_text(messages={"A": {}}), 1),
        (lock_text(messages={"A": {"file": "a.proto", "fields": {"1": "x"}}}), 1),
        (lock_text(messages={"A": {"file": "a.proto", "fields": {"one": "float x"}}}), 1),
        (lock_text(messages={"A": {"file": "a.proto", "fields": {}, "reserved": ["1 to"]}}), 1),
        (lock_text(messages={"A": {"file": "a.proto", "fields": {}, "reserved": 1}}), 1),
        (lock_text(enums={"A": {"file": "a.proto", "values": {"X": "1"}}}), 1),
        (lock_text(enums={"A": {"file": "a.proto", "values": {"1": 1}}}), 1),
    ],
)
def test_broken_lock_file_is_a_finding_in_it(compare: Compare, text: str, line: int) -> None:
    comparison = compare({"motor.proto": PROTO, LOCK_NAME: text})
    (finding,) = comparison.findings()
    assert (finding.code, finding.span.file, finding.span.line) == (Code.BAD_FILE, LOCK_NAME, line)
    with pytest.raises(TableError):
        comparison.extended()


names = st.from_regex(r"[a-z_]{1,8}", fullmatch=True)
FIELDS = st.tuples(names, st.sampled_from(["float", "repeated A.B"]), st.one_of(st.just(""), names))
FIELD_ENTRIES = st.dictionaries(st.integers(1, 2**29 - 1), FIELDS).map(
    lambda fields: frozenset(Entry(number, *declared) for number, declared in fields.items())
)
VALUE_ENTRIES = st.frozensets(st.builds(Entry, st.integers(-3, 2**31 - 1), names))


def declarations(entries: st.SearchStrategy[frozenset[Entry]]) -> st.SearchStrategy[dict[str, Declaration]]:
    ranges = st.frozensets(st.tuples(st.integers(-9, 9), st.integers(-9, 9)))
    return st.dictionaries(names, st.builds(Declaration, file=st.text(), reserved=ranges, entries=entries))


@given(st.builds(Lock, names, names, st.integers(0), declarations(FIELD_ENTRIES), declarations(VALUE_ENTRIES)))
def test_written_lock_reads_back_the_same(tmp_path_factory: pytest.TempPathFactory, written: Lock) -> None:
    path = tmp_path_factory.getbasetemp() / LOCK_NAME
    write_lock(path, written)
    assert read_lock(path) == written
