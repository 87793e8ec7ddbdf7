"""YAML texts to nodes with positions, and what a plain scalar means."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from router.errors import Code, Diagnostic, TableError
from router.table import compose
from router.table.compose import resolve, surprise
from router.table.nodes import MappingNode, Node, Plain, ScalarNode, SequenceNode
from router.table.source import read_source


@pytest.fixture(params=[yaml.CSafeLoader, yaml.SafeLoader], ids=["libyaml", "pure Python"], autouse=True)
def _loader(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compose, "LOADER", request.param)


def composed(folder: Path, text: str) -> tuple[Node | None, list[Diagnostic]]:
    path = folder / "t.yaml"
    path.write_bytes(text.encode("utf-8"))
    findings: list[Diagnostic] = []
    try:
        return compose.compose(read_source(path), {"X": "filled"}, findings), findings
    except TableError as error:
        return None, [*findings, *error.diagnostics]


def scalar(folder: Path, text: str) -> ScalarNode:
    """The value of the one key of a text."""
    root, findings = composed(folder, text)
    assert findings == []
    assert isinstance(root, MappingNode)
    [entry] = root.entries.values()
    assert isinstance(entry.value, ScalarNode)
    return entry.value


@pytest.mark.parametrize(
    ("text", "value", "columns", "stretches"),
    [
        ("k: accel_x  # c\n", "accel_x", (4, 11), [(0, 1, 4)]),
        ("k: 'a b'\n", "a b", (4, 9), [(0, 1, 5)]),
        ('k: "a b"\n', "a b", (4, 9), [(0, 1, 5)]),
        ("k: ü x\n", "ü x", (4, 7), [(0, 1, 4)]),
        ("k: 'it''s'\n", "it's", (4, 11), []),
        ('k: "a\\tb"\n', "a\tb", (4, 10), []),
        ("k: a\n   b\n", "a b", (4, 5), [(0, 1, 4), (2, 2, 4)]),
        ('k: "a\n   b"\n', "a b", (4, 6), [(0, 1, 5), (2, 2, 4)]),
        ("k: |\n   a\n", "a\n", (4, 5), [(0, 2, 4)]),
        ("k: >-  # c\n   a\n   b  c\n\n     d\n# c\n", "a b  c\n\n  d", (4, 11), [(0, 2, 4), (2, 3, 4), (10, 5, 6)]),
        ('k: "a\\\n   b"\n', "ab", (4, 7), []),
        ("k: ${X}\n", "filled", (4, 8), []),
        ("k: a\r\n", "a", (4, 5), [(0, 1, 4)]),
    ],
)
def test_an_expression_knows_where_its_text_stands(
    tmp_path: Path, text: str, value: str, columns: tuple[int, int], stretches: list[tuple[int, int, int]]
) -> None:
    found = scalar(tmp_path, text)
    assert found.value == value
    assert (found.span.line, found.span.column, found.span.end_column) == (1, *columns)
    assert [(offset, span.line, span.column) for offset, span in found.text_span.stretches] == stretches


def test_what_a_variable_holds_is_resolved_again(tmp_path: Path) -> None:
    assert scalar(tmp_path, "k: ${DEPTH:-10}\n").value == 10
    assert scalar(tmp_path, 'k: "${DEPTH:-10}"\n').value == "10"


def test_aliases_repeat_a_node_with_its_place(tmp_path: Path) -> None:
    root, findings = composed(tmp_path, "a: &x [1]\nb: *x\n")
    assert findings == []
    assert isinstance(root, MappingNode)
    first, second = root.get("a"), root.get("b")
    assert isinstance(first, SequenceNode)
    assert first is second
    assert first.span.line == 1


@pytest.mark.parametrize(
    ("text", "code", "place"),
    [
        ("a: @b\n", Code.BAD_YAML, (1, 4)),
        ("a: !x {b: 1}\n", Code.BAD_YAML, (1, 4)),
        ('a: "\\UFFFFFFFF"\n', Code.BAD_YAML, (1, 7)),
        ("a: [\n", Code.BAD_YAML, (1, 4)),
        ("a: {b: [1, 2],\n\n", Code.BAD_YAML, (1, 4)),
        ("a: x${Y}\n", Code.UNDEFINED_VARIABLE, (1, 5)),
        ("a: \"x${Y}\"\n", Code.UNDEFINED_VARIABLE, (1, 6)),
    ],
)  # fmt: skip
def test_one_mistake_is_one_finding_in_its_line(
    tmp_path: Path, text: str, code: Code, place: tuple[int, int], request: pytest.FixtureRequest
) -> None:
    _, [finding] = composed(tmp_path, text)
    assert finding.code is code
    if not ("pure Python" in request.node.name and code is Code.BAD_YAML):  # its sentences and places are its own
        assert (finding.span.line, finding.span.column) == place


@pytest.mark.parametrize(
    ("text", "place", "message", "hint"),
    [
        ("r:\n  - a: 1\n  - b: 2\n  c: 3\n", (4, 3), "does not start with '-'", "indent what belongs"),
        ("a\uff1a{b: c, d: e}\n", (1, 2), "U+FF1A (fullwidth colon)", "replace it with ':'"),
        ("a: {b: c\uff0cd: e}\n", (1, 9), "U+FF0C (fullwidth comma)", "replace it with ','"),
        ("a: \u201cb: c\u201d\n", (1, 4), "U+201C (left double quotation mark)", "replace it with '\"'"),
        ("a:\n  \u2013 b\n  - c: d\n", (2, 3), "U+2013 (en dash)", "replace it with '-'"),
        ("a:\u200bb\nc: d\n", (1, 3), "U+200B (zero width space)", "remove it"),
        ("a: {b: c: d}\n", (1, 9), "a ':' is not allowed here", "put braces around"),
        ("a: ['b' 'c']\n", (1, 9), "a ',' or ']' is missing before this", ""),
        ("a: [b, c}\n", (1, 9), "a ',' or ']' is missing before this", "replace it with ']'"),
        ("a: {b: {}, , c: d}\n", (1, 12), "a value is missing before this ','", "remove the ','"),
        ("a: [\n  - b]\n", (2, 3), "an item in brackets does not start with '-'", "remove the '-'"),
        ("r:\n  a: {}\n b: {}\n  c: {}\n", (3, 2), "indented by 1 space, its neighbours by 2 or 0", "equally"),
        ("a: {b: c:}\n", (1, 9), "a ':' is not allowed here", "remove it"),
        ("a: {b: c} // d\ne: f\n", (1, 11), "a comment starts with '#'", "with '#'"),
        ("a: b\n// c\nd: e\n", (2, 1), "a comment starts with '#'", "with '#'"),
        ("a:\n  b: 'it's'\n", (2, 10), "the quoted text ends before this", "the other kind of quotes"),
        ("a: [*b*, c]\n", (1, 5), "a value cannot start with '*'", "put quotes around"),
        ("a: !#b\n", (1, 4), "a value cannot start with '!'", "put quotes around"),
        ("a: > 5\n", (1, 4), "a value cannot start with '>'", "put quotes around"),
        ("it is old\nb: c\n", (1, 1), "a key without ':'", "start a comment with '#'"),
        ("<<<<<<< HEAD\na: b\n", (1, 1), "unresolved merge conflict", "keep one version"),
        ("a:\n  -b\n  - c: d\n", (2, 3), "a space is missing after '-'", "'- '"),
        ("a: {b:[c]}\n", (1, 6), "a space is missing after ':'", "write `: [`"),
        ("a : : b\n", (1, 5), "unexpected ':'", "remove it"),
        ("a:\n  b: [c] * 2\n", (2, 10), "the value ends before this", "quote the whole expression"),
        ("a: {b: c},\nd: e\n", (1, 10), "unexpected ','", "remove it"),
    ],
)  # fmt: skip
def test_a_syntax_error_names_the_mistake_and_the_remedy(
    tmp_path: Path, text: str, place: tuple[int, int], message: str, hint: str, request: pytest.FixtureRequest
) -> None:
    _, findings = composed(tmp_path, text)
    if "pure Python" not in request.node.name:  # its sentences and places are its own
        [finding] = findings
        assert (finding.span.line, finding.span.column) == place
        assert message in finding.message
        assert hint in finding.hint


@pytest.mark.parametrize("key", ["'a:'", "'-a'", "-1", "a:b", "a-b"])
def test_quoted_keys_and_numbers_are_not_misspelt(tmp_path: Path, key: str) -> None:
    assert composed(tmp_path, f"{{{key}: 1}}\n")[1] == []


def test_what_looks_like_a_negation_is_told_how_to_write_one(tmp_path: Path) -> None:
    _, [finding] = composed(tmp_path, "a: !b\n")
    assert finding.hint == "write `not b`"


@pytest.mark.parametrize("text", ["[" * 100_000, "a: " + "{b: " * 100_000, "- " * 100_000, "[" * 50 + "]" * 50])
def test_deep_nesting_is_one_finding(tmp_path: Path, text: str) -> None:
    root, [finding] = composed(tmp_path, text)
    assert root is None
    assert finding.code is Code.BAD_YAML
    assert "nested more than 32 levels deep" in finding.message


def test_an_alias_bomb_is_one_finding(tmp_path: Path) -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 31)]
    root, [finding] = composed(tmp_path, "\n".join(lines))
    assert root is None
    assert "more than 20000 values" in finding.message


def test_as_many_values_as_are_written_are_read(tmp_path: Path) -> None:
    root, findings = composed(tmp_path, f"&x a: [{'x, ' * 30_000}*x]")
    assert isinstance(root, MappingNode)
    assert findings == []


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("", None),
        ("null", None),
        ("true", True),
        ("FALSE", False),
        ("10", 10),
        ("-3", -3),
        ("0", 0),
        ("0x1F", 31),
        ("1.5", 1.5),
        ("1e3", 1000.0),
        (".5", 0.5),
        ("y", "y"),
        (".inf", ".inf"),
        (".nan", ".nan"),
        ("1" * 5000, "1" * 5000),
        ("accel_x", "accel_x"),
        ("192.168.0.30:8", "192.168.0.30:8"),
    ],
)
def test_plain_scalars_mean_what_yaml_1_2_says(text: str, value: Plain) -> None:
    found = resolve(text)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    "text",
    [
        *("yes", "Yes", "YES", "no", "On", "OFF", "~"),
        *("0777", "010", "08", "-017", "0o17", "0b101", "+0b1", "-0x1F", "0x_1F", "0x1_F"),
        *("12:30", "1:2:3.5", "40:8", "1_000", "1_0.5", "1.5_0", "1_0e3"),
        *("2026-11-21", "2026-1-2", "2026-11-21T10:00:00Z", "2026-11-21 10:00:00.5 +01:00"),
    ],
)
def test_what_yaml_1_1_reads_differently_is_a_surprise(text: str) -> None:
    assert surprise(text)


@pytest.mark.parametrize(
    "text",
    [
        *("y", "n", "x", "true", "null", "", "0", "10", "-1", "0x1F", "1.5", "1e3", "0.5", ".5"),
        *("127.0.0.1:8", "accel_x", "_1", "sensor_board", "1_a", "a:1", "1:60", "yes please", "2026", "-", "0.10"),
    ],
)
def test_what_everybody_reads_alike_is_none(text: str) -> None:
    assert surprise(text) is None


@pytest.mark.parametrize("value", ["sensor_board,", "200ms,", "8,"])
def test_a_word_that_ends_with_a_comma_is_one_only_within_brackets(value: str, tmp_path: Path) -> None:
    _, findings = composed(tmp_path, f"a: {value}")
    assert [each.message for each in findings] == [f"'{value}' ends with a ','"]
    for good in (f"a: {{b: {value}}}", f"a: '{value}'", f"a: some {value}", f"a: [{value} b]"):
        assert composed(tmp_path, good)[1] == []


@pytest.mark.parametrize("character", ["\u00a0", "\u2009", "\u200b"])
def test_a_character_in_a_key_that_looks_like_a_space_is_named(character: str, tmp_path: Path) -> None:
    _, findings = composed(tmp_path, f"{{a:{character}b, c: d}}")
    assert [each.message for each in findings] == [f"this key contains the character U+{ord(character):04X}"]
