"""Finds test files, checks them against their schema, reads them, and compiles the table under test."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from router.compiler import Checked, check_table
from router.compiler.compiled_table import CompiledTable
from router.compiler.lookup import Definitions
from router.compiler.resolution import with_stand_ins
from router.errors import (
    Code,
    Diagnostic,
    Located,
    SourceSpan,
    TableError,
    UsageError,
    did_you_mean,
    did_you_mean_file,
    shown_path,
)
from router.rehearsal.fields import offset
from router.rehearsal.steps import Expected, ExpectedReader, GivenReader, Names, Step
from router.table.compose import compose
from router.table.nodes import MappingNode, Node, ScalarNode, SequenceNode, is_valid, key_at, node_at
from router.table.reading import InvalidValueError, mapping, parsed
from router.table.schema import schema_errors
from router.table.shape import finding, subject, unknown_keys
from router.table.source import TEST_ENDINGS, read_source
from router.table.units import parse_duration

R = TypeVar("R")

SCHEMA = "schemas/table-test.schema.json"


@dataclass(frozen=True, slots=True)
class TableTest:
    name: str
    span: SourceSpan
    steps: tuple[Step, ...]


@dataclass(frozen=True, slots=True)
class TestFile:
    """The tests of a file, and their table with its program."""

    __test__ = False  # for pytest, which would take this for a class of tests

    checked: Checked
    program: CompiledTable
    tests: tuple[TableTest, ...]


def find_test_files(paths: Sequence[Path]) -> list[Path]:
    """Return the files that the paths stand for, each once: a folder stands for the test files in it.

    Raises UsageError.
    """
    files: dict[Path, None] = {}
    for path in paths:
        if os.path.isdir(path):  # noqa: PTH112  (Path.is_dir raises if a parent folder is not readable)
            try:
                inside = sorted(
                    file for file in path.iterdir() if file.name.endswith(TEST_ENDINGS) and file.name[0] != "."
                )
            except OSError as error:
                raise UsageError(f"the folder '{path}' cannot be read: {error.strerror}") from error
            files.update(dict.fromkeys(inside))
        else:
            files[path] = None
    return list(files)


def read_test_file(path: Path, definitions: Definitions) -> TestFile:
    """Read a test file. Raises TableError with every finding in the file, or in its table."""
    root = _checked_nodes(path)
    variables = _Variables(_variables(root))
    checked = check_table(_table_of(root, path), variables, definitions)
    if checked.program is None:
        raise TableError(checked.diagnostics)
    if unused := [name for name in variables if name not in variables.names_read]:
        key = mapping(root.get("variables")).entries[unused[0]].key
        message = f"{shown_path(checked.path)} has no variable '{unused[0]}'"
        raise TableError([Diagnostic(key.span, Code.BAD_VALUE, message, did_you_mean(unused[0], variables.names_read))])
    if checked.program.table.routes_span is None:
        message, hint = f"{shown_path(checked.path)} has no routes", "only routes are tested, gateways are not"
        raise TableError([Diagnostic(SourceSpan(shown_path(path)), Code.BAD_FILE, message, hint)])
    program = with_stand_ins(checked.program)
    reader = _Reader(Names(checked, program))
    tests = root.get("tests")
    assert isinstance(tests, MappingNode)  # noqa: S101 - the schema saw to it
    read = tuple(reader.test(name, entry.key.span, entry.value) for name, entry in tests.entries.items())
    if reader.findings:
        raise TableError(reader.findings)
    return TestFile(checked, program, read)


def _table_of(root: MappingNode, path: Path) -> Path:
    named = root.get("table")
    if isinstance(named, ScalarNode):
        table = Path(os.path.normpath(path.parent / named.text))
        if not table.is_file():
            message = f"there is no table '{named.text}' beside this file"
            raise TableError([Diagnostic(named.span, Code.BAD_FILE, message, did_you_mean_file(named.text, table))])
        return table
    for ending in TEST_ENDINGS:
        if path.name.endswith(ending):
            table = path.with_name(path.name.removesuffix(ending) + ending.removeprefix(".test"))
            if table.is_file():
                return table
    message, hint = "this file is not named after a table beside it", "name its table, for example 'table: rover.yaml'"
    raise TableError([Diagnostic(SourceSpan(shown_path(path)), Code.BAD_FILE, message, hint)])


def _variables(root: MappingNode) -> Mapping[str, str]:
    node = root.get("variables")
    entries = node.entries if isinstance(node, MappingNode) else {}
    return {name: entry.value.text for name, entry in entries.items() if isinstance(entry.value, ScalarNode)}


class _Variables(dict[str, str]):
    """Values by name; `names_read` are those that were looked up."""

    def __init__(self, values: Mapping[str, str]) -> None:
        super().__init__(values)
        self.names_read: set[str] = set()

    def get(self, name: str, default: Any = None) -> Any:
        self.names_read.add(name)
        return super().get(name, default)


class _Reader:
    """Reads tests. Errors are added to `findings`, and the rest of the file is still read."""

    def __init__(self, names: Names) -> None:
        self.findings: list[Diagnostic] = []
        self._given = GivenReader(names)
        self._expected = ExpectedReader(names)

    def test(self, name: str, span: SourceSpan, node: Node) -> TableTest:
        assert isinstance(node, MappingNode)  # noqa: S101 - the schema saw to it
        steps = node.get("steps")
        if steps is None:
            return TableTest(name, span, tuple(self._steps(span, [node])))
        others = [key for key in node.entries if key != "steps"]
        if others:
            message = f"'{others[0]}' is beside 'steps'"
            self._find(node.entries[others[0]].key.span, Code.UNKNOWN_KEY, message, "move it into a step")
        listed = steps.items if isinstance(steps, SequenceNode) else ()
        return TableTest(name, span, tuple(self._steps(span, listed)))

    def _steps(self, span: SourceSpan, nodes: Iterable[Node]) -> Iterator[Step]:
        latest, is_stopped = 0, False
        for node in nodes:
            step = self._step(span, node)
            if is_stopped:
                message, hint = "the step above stops the router", "write a separate test for this step"
                self._find(step.span, Code.BAD_VALUE, message, hint)
            latest = self._in_order("at", step.at, latest, node)
            if step.given is not None:
                latest += (step.given.times - 1) * step.given.every
            latest = self._in_order("until", step.until, latest, node)
            is_stopped = step.stop
            yield step

    def _in_order(self, key: str, time: int | None, latest: int, node: Node) -> int:
        """Return the time of a step's key, ns, or `latest` if that is later. A time before `latest` is a finding."""
        if time is not None and time < latest and isinstance(node, MappingNode):
            message = f"this is {offset(time)}, earlier than the {offset(latest)} above"
            self._find(node.entries[key].value.span, Code.BAD_VALUE, message, "write steps in the order of time")
        return max(latest, time or 0)

    def _step(self, test: SourceSpan, node: Node) -> Step:
        assert isinstance(node, MappingNode)  # noqa: S101 - the schema saw to it
        span = next(iter(node.entries.values())).key.span if node.entries else test
        expect = node.entries.get("expect")
        if expect is None:
            message = "this step has no 'expect'"
            self._find(span, Code.MISSING_KEY, message, "write what it expects, or 'expect: nothing'")
            return Step(span, Expected(span))
        given = node.get("given")
        expected = self._read(lambda written: self._expected.expected(expect.key.span, written, given), expect.value)
        return Step(
            span=span,
            expected=expected or Expected(expect.key.span),
            given=self._read(self._given.given, given),
            at=self._read(_duration, node.get("at")),
            until=self._read(_duration, node.get("until")),
            stop=node.get("stop") is not None,
        )

    def _read(self, read: Callable[[Node], R], node: Node | None) -> R | None:
        """Return the value that `read` returns; None for a missing key, and for a value with a finding."""
        if node is None:
            return None
        try:
            return read(node)
        except InvalidValueError as error:
            self.findings.append(error.diagnostic)
            return None

    def _find(self, span: SourceSpan, code: Code, message: str, hint: str) -> None:
        self.findings.append(Diagnostic(span, code, message, hint))


def _duration(node: Node) -> int:
    """Return the value of `at` or `until`, which may be zero, unlike other durations."""
    assert isinstance(node, ScalarNode)  # noqa: S101 - the schema saw to it
    is_zero = not node.text.strip("0. nsumih")
    return 0 if is_zero else parsed(parse_duration, Located(node.text, node.span))


# The shape of a file


def _checked_nodes(path: Path) -> MappingNode:
    """Return the nodes of a test file that fits its schema. Raises TableError with every finding."""
    findings: list[Diagnostic] = []
    source = read_source(path)
    message = "a test file is a mapping with the key 'tests'"
    if not source.text.strip():
        raise TableError([Diagnostic(SourceSpan(source.file), Code.WRONG_TYPE, message)])
    root = compose(source, {}, findings)
    if not isinstance(root, MappingNode):
        raise TableError([*findings, Diagnostic(root.span, Code.WRONG_TYPE, message)])
    if not findings and is_valid(root):
        findings += _schema_findings(root, SourceSpan(source.file))
    if findings:
        raise TableError(sorted(findings, key=lambda finding: (finding.span, finding.message)))
    return root


def _schema_findings(root: MappingNode, whole: SourceSpan) -> Iterator[Diagnostic]:
    errors = schema_errors(root, SCHEMA)
    empty = {error.path for error in errors if error.lacks_mapping}
    misspelt = {error.path for error in errors if error.keyword == "additionalProperties"}
    for error in errors:
        if error.keyword == "additionalProperties":
            owner = subject(error.path) if error.path else "a test file"
            yield from unknown_keys(root, error.path, list(error.schema["properties"]), owner, empty, SCHEMA)
        elif not error.path and error.path not in misspelt:
            yield Diagnostic(whole, Code.MISSING_KEY, "the test file has no key 'tests'")
        elif error.keyword == "required" and error.path in misspelt:
            continue  # the missing key may be the misspelt one
        elif error.keyword == "required":
            key = key_at(root, error.path)
            missing = error.message.split("'")[1]
            message = f"this step has no '{missing}'"
            yield Diagnostic(key.span if key else node_at(root, error.path).span, Code.MISSING_KEY, message)
        else:
            yield finding(error, root)
