"""protoc is run, and what it complains about becomes findings."""

from __future__ import annotations

import errno
import tempfile

import pytest

from router.errors import Code, SourceSpan, StartError, TableError
from router.types.protobuf import load_protos
from tests.types.conftest import Refused, Write, proto, settings, with_envelope


def test_nothing_is_printed(write: Write, capfd: pytest.CaptureFixture[str]) -> None:
    unused_import = {"a.proto": proto('import "b.proto";'), "b.proto": proto("message B {}")}
    load_protos(*settings(with_envelope(write(unused_import))))
    assert capfd.readouterr() == ("", "")


def test_a_folder_may_have_a_name_at_which_protoc_would_split(write: Write) -> None:
    root = write({"a:b=c/a.proto": proto("message Envelope {}")}) / "a:b=c"
    assert list(load_protos(*settings(root)).messages) == ["Envelope"]


def test_files_that_change_while_they_are_compiled_are_a_finding(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    root = write({"a.proto": proto("message Envelope {}")})

    def break_off(*_: object) -> None:
        (root / "a.proto").write_text("message")

    monkeypatch.setattr("router.types.protoc._protoc_compiler.get_protos", break_off)  # the first look
    with pytest.raises(TableError, match=r"try again: the files may have changed in the meantime"):
        load_protos(*settings(root))


def test_a_full_disk_is_no_obstacle(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    root = write({"a.proto": proto("message Envelope {}")})
    monkeypatch.setattr(tempfile, "tempdir", str(root / "none"))
    assert list(load_protos(*settings(root)).messages) == ["Envelope"]


def test_without_a_temporary_folder_the_start_says_so(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    root = write({"a.proto": proto("message Envelope {}")})

    def refuse(**_: object) -> None:
        raise FileNotFoundError(errno.ENOENT, "No usable temporary directory found in ['/tmp', '/']")

    monkeypatch.setattr("router.types.protoc.tempfile.TemporaryDirectory", refuse)
    with pytest.raises(StartError, match=r"none is writable: No usable temporary directory") as refused:
        load_protos(*settings(root))
    assert refused.value.hint == "make /tmp writable, or set TMPDIR to a writable folder"


@pytest.mark.parametrize(
    ("body", "finding"),
    [
        pytest.param(
            "message A {\n  reserved 3;\n  int32 x = 3;\n}",
            'a.proto:3:12: error[wire-number-conflict]: Field "x" uses reserved number 3; '
            "Suggested field numbers for A: 1",
            id="reserved number",
        ),
        pytest.param(
            'message A {\n  reserved "x";\n  int32 x = 3;\n}',
            'a.proto:4:9: error[wire-number-conflict]: Field name "x" is reserved',
            id="reserved name",
        ),
        pytest.param(
            "enum E {\n  X = 0;\n  Y = 0;\n}",
            'a.proto:4:7: error[wire-number-conflict]: "Y" uses the same enum value as "X"; '
            "use 1, the next free number, or write `option allow_alias = true;` in the enum",
            id="enum value used twice",
        ),
        pytest.param(
            "message A {\n  int32 x = 1;\n  int32 x = 2;\n}",
            'a.proto:4:9: error[bad-proto]: "x" is already defined in "A"',
            id="field declared twice",
        ),
        pytest.param(
            "message A {\n  Motr motor = 1;\n}",
            "a.proto:3:3: error[bad-proto]: \"Motr\" is not defined; did you mean 'Motor'?",
            id="unknown type",
        ),
        pytest.param(
            "message A {\n\tint32 x = 1;\n\t/* gr\u00f6\u00dfe */ int32 y = 1;\n}",
            'a.proto:4:24: error[wire-number-conflict]: Field number 1 has already been used in "A" by field "x"; '
            "use 2, the next free number",
            id="column after tabs and other scripts",
        ),
    ],
)
def test_error_of_protoc_has_file_line_column_and_code(refused: Refused, body: str, finding: str) -> None:
    findings = refused({"a.proto": proto(body), "common/motor.proto": proto("message Motor {}")})
    assert [str(found) for found in findings] == [finding]


def test_same_message_in_two_files_is_blamed_on_the_second(refused: Refused) -> None:
    (finding,) = refused({"a.proto": proto("message A {}"), "b.proto": proto("\nmessage A {}")})
    assert (finding.code, finding.span) == (Code.DUPLICATE_MESSAGE, SourceSpan("b.proto", 3, 9, 10))


def test_every_broken_file_is_reported_but_not_what_imports_it(refused: Refused) -> None:
    findings = refused(
        {
            "a.proto": proto("message A { int32 x = 1 }"),
            "b.proto": proto("message B { int32 x = 0; }"),
            "c.proto": proto('import "a.proto";\nmessage C { A a = 1; }'),
        }
    )
    assert [finding.span.file for finding in findings] == ["a.proto", "b.proto"]


def test_missing_import_hides_what_another_file_imports_too(refused: Refused) -> None:
    findings = refused(
        {
            "a.proto": proto('import "b.proto";\nimport "sub/c.proto";\nmessage A { B b = 1; C c = 2; }'),
            "b.proto": proto('import "c.proto";\nmessage B { C c = 1; }'),
            "c.proto": proto("message C {}"),
        }
    )
    assert [(finding.message, finding.hint) for finding in findings] == [
        ("there is no file 'sub/c.proto' to import", "did you mean 'c.proto'?")
    ]


def test_type_of_an_imported_file_with_another_package_is_told_with_its_name(refused: Refused) -> None:
    (finding,) = refused(
        {
            "a.proto": proto('import "b.proto";\nmessage A { B b = 1; }'),
            "b.proto": proto("package rover;\nmessage B {}"),
        }
    )
    assert (finding.message, finding.hint) == ('"B" is not defined', "b.proto declares rover.B")
