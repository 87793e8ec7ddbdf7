"""Test files to data: each name is looked up in the table under test, so that a test of what is not there is a finding.

Knows the language of tests; what a field's value may be is `table_tests_values`'.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TypeVar

from router.compiler import check_table
from router.compiler.lookup import Definitions
from router.errors import Code, Diagnostic, Located, SourceSpan, TableError, shown_path
from router.rehearsal.expected import ExpectedReader
from router.rehearsal.given import GivenReader
from router.rehearsal.model import Expected, Step, TableTest, TableTestFile
from router.rehearsal.names import Names
from router.rehearsal.shape import read_shape
from router.rehearsal.shown import offset
from router.table.nodes import MappingNode, Node, ScalarNode, SequenceNode
from router.table.reading import InvalidValueError, parsed
from router.table.units import parse_duration

R = TypeVar("R")
ENDINGS = (".test.yaml", ".test.yml")


def read_test_file(path: Path, definitions: Definitions) -> TableTestFile:
    """Raises TableError: with what is wrong with the file, or with its table."""
    root = read_shape(path)
    checked = check_table(_table_of(root, path), _variables(root), definitions)
    if checked.program is None:
        raise TableError(checked.diagnostics)
    if checked.program.table.routes_span is None:
        message, hint = f"{shown_path(checked.path)} has no routes", "only routes are tested, gateways are not"
        raise TableError([Diagnostic(SourceSpan(shown_path(path)), Code.BAD_FILE, message, hint)])
    findings: list[Diagnostic] = []
    reader = _Reader(Names(checked), findings)
    tests = root.get("tests")
    assert isinstance(tests, MappingNode)  # noqa: S101 - the schema saw to it
    found = tuple(reader.test(name, entry.key.span, entry.value) for name, entry in tests.entries.items())
    if findings:
        raise TableError(findings)
    return TableTestFile(path, shown_path(path), checked, found)


def _table_of(root: MappingNode, path: Path) -> Path:
    named = root.get("table")
    if isinstance(named, ScalarNode):
        table = Path(os.path.normpath(path.parent / named.text))
        if not table.is_file():
            message = f"there is no table '{named.text}' beside this file"
            raise TableError([Diagnostic(named.span, Code.BAD_FILE, message)])
        return table
    for ending in ENDINGS:
        if path.name.endswith(ending):
            table = path.with_name(path.name.removesuffix(ending) + ending.removeprefix(".test"))
            if table.is_file():
                return table
    message, hint = "this file is not named after a table beside it", "say which it tests, such as 'table: rover.yaml'"
    raise TableError([Diagnostic(SourceSpan(shown_path(path)), Code.BAD_FILE, message, hint)])


def _variables(root: MappingNode) -> Mapping[str, str]:
    node = root.get("variables")
    entries = node.entries if isinstance(node, MappingNode) else {}
    return {name: entry.value.text for name, entry in entries.items() if isinstance(entry.value, ScalarNode)}


class _Reader:
    """Reads tests; what is wrong goes to `findings`, and the rest of the file is still read."""

    def __init__(self, names: Names, findings: list[Diagnostic]) -> None:
        self._given = GivenReader(names)
        self._expected = ExpectedReader(names)
        self._findings = findings

    def test(self, name: str, span: SourceSpan, node: Node) -> TableTest:
        assert isinstance(node, MappingNode)  # noqa: S101 - the schema saw to it
        steps = node.get("steps")
        if steps is None:
            return TableTest(name, span, tuple(self._steps(span, [node])))
        others = [key for key in node.entries if key != "steps"]
        if others:
            message = f"'{others[0]}' stands beside 'steps'"
            hint = "move it into a step"
            self._findings.append(Diagnostic(node.entries[others[0]].key.span, Code.UNKNOWN_KEY, message, hint))
        listed = steps.items if isinstance(steps, SequenceNode) else ()
        return TableTest(name, span, tuple(self._steps(span, listed)))

    def _steps(self, span: SourceSpan, nodes: Iterable[Node]) -> Iterable[Step]:
        latest, is_stopped = 0, False
        for node in nodes:
            step = self._step(span, node)
            if is_stopped:
                what, hint = "the router is stopped in the step above", "what comes then is another test"
                self._findings.append(Diagnostic(step.span, Code.BAD_VALUE, what, hint))
            latest = self._in_time("at", step.at, latest, node)
            if step.given is not None:
                latest += (step.given.repetition.times - 1) * step.given.repetition.every
            latest = self._in_time("until", step.until, latest, node)
            is_stopped = step.stop
            yield step

    def _in_time(self, key: str, time: int | None, latest: int, node: Node) -> int:
        """The time of a key of a step, ns, which is not before the `latest` of what stands above."""
        if time is not None and time < latest and isinstance(node, MappingNode):
            what = f"this is {offset(time)}, before the {offset(latest)} of what stands above"
            hint = "steps are in the order of time"
            self._findings.append(Diagnostic(node.entries[key].value.span, Code.BAD_VALUE, what, hint))
        return max(latest, time or 0)

    def _step(self, test: SourceSpan, node: Node) -> Step:
        assert isinstance(node, MappingNode)  # noqa: S101 - the schema saw to it
        span = next(iter(node.entries.values())).key.span if node.entries else test
        expect = node.entries.get("expect")
        if expect is None:
            message = "this says nothing of what is expected"
            self._findings.append(Diagnostic(span, Code.MISSING_KEY, message, "say 'expect: nothing', or what"))
            return Step(span, Expected(span))
        given = node.get("given")
        expected = self._sound(lambda found: self._expected.expected(expect.key.span, found, given), expect.value)
        return Step(
            span=span,
            expected=expected or Expected(expect.key.span),
            given=self._sound(self._given.given, given),
            at=self._sound(_duration, node.get("at")),
            until=self._sound(_duration, node.get("until")),
            stop=node.get("stop") is not None,
        )

    def _sound(self, read: Callable[[Node], R], node: Node | None) -> R | None:
        """None for a key that is not there, and for what has a finding."""
        if node is None:
            return None
        try:
            return read(node)
        except InvalidValueError as error:
            self._findings.append(error.diagnostic)
            return None


def _duration(node: Node) -> int:
    assert isinstance(node, ScalarNode)  # noqa: S101 - the schema saw to it
    written = Located(node.text, node.span)
    return 0 if _is_zero(written.value) else parsed(parse_duration, written)


def _is_zero(text: str) -> bool:
    """A time may be zero; elsewhere durations may not."""
    return not text.strip("0. nsumih")
