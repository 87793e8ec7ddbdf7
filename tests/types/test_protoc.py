"""Running protoc inside the process."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from router.errors import TableError
from router.types.protobuf import load_protos
from tests.types.conftest import settings, with_envelope

Write = Callable[[Mapping[str, str]], Path]


def proto(body: str) -> str:
    return f'syntax = "proto3";\n{body}\n'


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
    with pytest.raises(TableError, match=r"perhaps they changed meanwhile: try again"):
        load_protos(*settings(root))
