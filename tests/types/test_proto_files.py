"""Folders of `.proto` files that cannot be read, and files that protoc would stumble over."""

from __future__ import annotations

from pathlib import Path

import pytest

from router.errors import Code, SourceSpan, TableError
from router.types.proto_files import read_folder
from router.types.protobuf import load_protos
from tests.types.conftest import Refused, Write, refusal, settings


def test_folder_without_protos_is_a_finding(write: Write) -> None:
    with pytest.raises(TableError, match=r"contains no \.proto file"):
        load_protos(*settings(write({"readme.txt": "nothing here"})))


def test_unreadable_proto_that_is_imported_is_a_finding_at_that_file(write: Write) -> None:
    root = write({"a.proto": 'syntax = "proto3"; import "b.proto"; message Envelope {}'})
    (root / "b.proto").symlink_to("nowhere.proto")
    assert [(finding.code, finding.span.file) for finding in refusal(root)] == [(Code.BAD_FILE, "b.proto")]


def test_proto_that_is_not_utf8_is_a_finding_at_that_line(write: Write) -> None:
    root = write({"a.proto": ""})
    (root / "a.proto").write_bytes(b'syntax = "proto3";\n// gr\xf6sse\nmessage Envelope {}')
    assert [str(finding) for finding in refusal(root)] == ["a.proto:2:1: error[bad-file]: the file is not UTF-8"]


def test_hidden_files_of_editors_and_archives_are_left_alone(write: Write) -> None:
    root = write(
        {
            "a.proto": 'syntax = "proto3"; message Envelope {}',
            "._a.proto": "message Envelope {}",
            ".git/b.proto": "message Envelope {}",
        }
    )
    assert load_protos(*settings(root)).files == ("a.proto",)


@pytest.mark.parametrize("name", ['a"b.proto', "a\\b.proto", "gr\u00f6\u00dfe.proto", "a\nb.proto"])
def test_file_that_protoc_cannot_import_is_a_finding(refused: Refused, name: str) -> None:
    (finding,) = refused({name: 'syntax = "proto3"; message Envelope {}'})
    assert (finding.code, "protoc cannot import" in finding.message) == (Code.BAD_FILE, True)


@pytest.mark.parametrize("text", ["", "message A {}", "// syntax = nothing\nmessage A {}"])
def test_proto_without_syntax_is_a_finding(refused: Refused, text: str) -> None:
    assert [str(finding) for finding in refused({"a.proto": text})] == [
        'a.proto:1:1: error[bad-proto]: the file does not declare its syntax; start it with `syntax = "proto3";`'
    ]


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        ("../proto", "'../protos'"),
        ("protos", "'../protos'"),
        ("../protos/a.proto", "name its folder"),
        ("x", "relative to the table"),
    ],
)
def test_a_folder_that_is_not_there_is_told_with_what_is(tmp_path: Path, written: str, meant: str) -> None:
    (tmp_path / "protos").mkdir()
    (tmp_path / "protos" / "a.proto").touch()
    (tmp_path / "routes").mkdir()
    table = tmp_path / "routes" / "table.yaml"
    with pytest.raises(TableError) as refused:
        read_folder(table.parent / written, SourceSpan(str(table), 1))
    [finding] = refused.value.diagnostics
    assert str((table.parent / written).resolve()) in finding.message
    assert meant in finding.hint
