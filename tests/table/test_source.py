"""Texts of table files, and the variables in them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from router.errors import Code, Diagnostic, TableError
from router.table.source import MAX_BYTES, fill, read_source


def refused(path: Path) -> Diagnostic:
    with pytest.raises(TableError) as caught:
        read_source(path)
    [finding] = caught.value.diagnostics
    return finding


@pytest.mark.parametrize(
    ("data", "code", "place"),
    [
        (b"a: 1\nb: \xff\n", Code.BAD_FILE, (2, 4)),
        ("a: ü\nü: ".encode() + b"\xc3", Code.BAD_FILE, (2, 4)),
        ("a: 1".encode("utf-16"), Code.BAD_FILE, (1, 1)),
        (b"a: 1\nb: x\0y\n", Code.BAD_YAML, (2, 5)),
        (b"a: 1\r\nb: \x1b[31m\n", Code.BAD_YAML, (2, 4)),
        ("a: 1\rb: x\u2028y\n".encode(), Code.BAD_YAML, (2, 5)),
    ],
)
def test_characters_that_no_table_has_are_found(
    tmp_path: Path, data: bytes, code: Code, place: tuple[int, int]
) -> None:
    path = tmp_path / "t.yaml"
    path.write_bytes(data)
    finding = refused(path)
    assert (finding.code, (finding.span.line, finding.span.column)) == (code, place)


def test_a_byte_order_mark_is_no_part_of_the_text(tmp_path: Path) -> None:
    path = tmp_path / "t.yaml"
    path.write_bytes(b"\xef\xbb\xbfa: 1\n")
    assert read_source(path).text == "a: 1\n"


def test_lines_end_as_editors_see_them(tmp_path: Path) -> None:
    path = tmp_path / "t.yaml"
    path.write_bytes(b"a\r\nb\rc\nd")
    assert read_source(path).lines == ("a", "b", "c", "d")


def test_what_is_no_file_is_one_finding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    Path("loop").symlink_to("pool")
    Path("pool").symlink_to("loop")
    found = {path: refused(Path(path)) for path in (".", "pipe", "loop", os.devnull, "a\0b", "x" * 300, "nope.yaml")}
    assert {finding.code for finding in found.values()} == {Code.BAD_FILE}
    assert "folder" in found["."].message
    assert "too long" in found["x" * 300].message
    assert "not a directory" in refused(Path(__file__) / "nope.yaml").message
    assert all("not a regular file" in found[path].message for path in ("pipe", os.devnull))
    assert "no such file" in found["nope.yaml"].message
    assert str(tmp_path) in found["nope.yaml"].hint, "where a relative path begins"
    assert refused(tmp_path / "nope.yaml").hint == ""


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_file_that_may_not_be_read_is_one_finding(tmp_path: Path) -> None:
    path = tmp_path / "t.yaml"
    path.write_text("a: 1")
    path.chmod(0)
    assert "permission denied" in refused(path).message


def test_a_file_of_any_size_is_not_read_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "t.yaml"
    with path.open("wb") as stream:
        stream.truncate(MAX_BYTES + 1)
    assert "larger than 4 MiB" in refused(path).message


ENVIRON = {"HOST": "10.0.0.1", "EMPTY": "", "NESTED": "${HOST}"}


@pytest.mark.parametrize(
    ("text", "filled"),
    [
        ("${HOST}:8", "10.0.0.1:8"),
        ("${HOST:-1.2.3.4}", "10.0.0.1"),
        ("${NOPE:-1.2.3.4}:8", "1.2.3.4:8"),
        ("${NOPE:-}", ""),
        ("${EMPTY}", ""),
        ("${EMPTY:-default}", "default"),
        ("${HOST}${HOST}", "10.0.0.110.0.0.1"),
        ("${NOPE:-a b:c}", "a b:c"),
        ("$HOST costs 5$", "$HOST costs 5$"),
    ],
)
def test_variables_are_filled_in(text: str, filled: str) -> None:
    assert fill(text, ENVIRON) == (filled, [])


@pytest.mark.parametrize(
    ("text", "bad", "code"),
    [
        ("a${NOPE}b", "${NOPE}", Code.UNDEFINED_VARIABLE),
        ("${HOST", "${HOST", Code.BAD_VALUE),
        ("${}x", "${}", Code.BAD_VALUE),
        ("${1A}", "${1A}", Code.BAD_VALUE),
        ("${HOST-x}", "${HOST-x}", Code.BAD_VALUE),
        ("${NOPE:-${HOST}}", "${NOPE:-${HOST}", Code.BAD_VALUE),
        ("${NESTED}", "${NESTED}", Code.BAD_VALUE),
    ],
)
def test_what_cannot_be_filled_in_is_blamed_itself(text: str, bad: str, code: Code) -> None:
    _, [problem] = fill(text, ENVIRON)
    assert text[problem.start : problem.end] == bad
    assert problem.code is code


def test_every_problem_is_reported() -> None:
    _, problems = fill("${A}${B}", {})
    assert [problem.start for problem in problems] == [0, 4]


def test_a_misspelt_variable_gets_a_suggestion() -> None:
    _, [problem] = fill("${BASESTATON}", {"BASESTATION": "x"})
    assert problem.hint.startswith("did you mean 'BASESTATION'?")
