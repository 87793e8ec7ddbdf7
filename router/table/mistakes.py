"""Mistakes in writing YAML, in words that say what to do, at the line that has the mistake.

Some make the text no YAML (`explain`). One is YAML and means something else than it seems to: a comment that looks like
the rest of an expression, as in `x # 1000` (`cut_findings`).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import yaml

from router.errors import Code, Diagnostic, SourceSpan
from router.table.nodes import MappingNode, Node, ScalarNode, SequenceNode
from router.table.reading import is_text
from router.table.source import Source


class _Advice(NamedTuple):
    """What is wrong and what to do. With `at_start` the place is where the construct begins."""

    what: str
    hint: str = ""
    at_start: bool = False


_TAB = _Advice("a tab indents this line", "indent with spaces")
_OPEN_QUOTE = _Advice("this quote is not closed in its line", at_start=True)
_NO_COLON = _Advice("this line has a key without ':'", at_start=True)
_NO_KEY_ENDS = "could not find expected ':'"
_QUOTE_COLONS = "quote text that has ': ' in it"
_ADVICE = {
    "did not find expected ',' or ']'": _Advice(
        "this '[' is not closed by a ']', or a ',' is missing inside", at_start=True
    ),
    "did not find expected ',' or '}'": _Advice(
        "this '{' is not closed by a '}', or a ',' is missing inside", at_start=True
    ),
    "found unexpected end of stream": _OPEN_QUOTE,
    "found unexpected document indicator": _OPEN_QUOTE,
    "found unknown escape character": _Advice(
        "this backslash sequence does not exist", "single quotes take backslashes as they are"
    ),
    "mapping values are not allowed in this context": _Advice("a ':' cannot stand here", _QUOTE_COLONS),
    _NO_KEY_ENDS: _NO_COLON,
    "did not find expected key": _Advice("no key begins here", "quote text that has special characters in it"),
    "did not find expected '-' indicator": _Advice(
        "this line does not begin with '-' as its neighbours do", "indent what belongs to the item above"
    ),
    "block sequence entries are not allowed in this context": _Advice(
        "a '-' cannot begin an item here", "items of a sequence begin on lines of their own"
    ),
    "did not find expected node content": _Advice("a value is missing here"),
    "did not find expected <document start>": _Advice(
        "this line is indented less than the first key", "indent keys of one mapping alike"
    ),
    "found incompatible YAML document": _Advice("this is a YAML version that is not understood", "remove the line"),
}
_NOT_CLOSED = ("did not find expected ',' or ']'", "did not find expected ',' or '}'")
_COMMENT = re.compile(r"(?:^|\s)#.*")
_SEPARATOR = re.compile(r":(?=\s|$)")
_WITHOUT_SPACE = re.compile(r"[ -]*[A-Za-z_]\w*:(?=\S)")


def explain(
    error: yaml.MarkedYAMLError, source: Source, open_quote: SourceSpan | None, open_bracket: SourceSpan | None
) -> Diagnostic:
    """The finding for one syntax error.

    `open_quote` is where the quoted scalar before the error begins, if it goes over several lines: then
    its closing quote is most likely the next one's opening quote. `open_bracket` is the innermost
    bracket around the error: where the text ends within it, it lacks its counterpart.
    """
    line = error.problem_mark.line if error.problem_mark else 0
    column = error.problem_mark.column if error.problem_mark else 0
    if open_quote:
        return Diagnostic(open_quote, Code.BAD_YAML, _OPEN_QUOTE.what)
    if open_bracket and not any(text.strip() for text in source.lines[line:]):
        return Diagnostic(open_bracket.part(0, 1), Code.BAD_YAML, "this bracket is never closed")
    written = source.lines[line] if line < len(source.lines) else ""
    if not open_bracket and written[column : column + 1] != "\t":
        begun = error.context_mark.line if error.problem == _NO_KEY_ENDS and error.context_mark else None
        if (bare := _bare_line(source, line) if begun is None else begun) is not None:
            return _without_colon(source, bare)
        if (neighbours := _neighbours(source, line)) and not _SEPARATOR.search(written[:column]):
            return _misplaced(source, line, neighbours)
    advice = _advice(error, written, column)
    if advice.at_start and error.context_mark:
        line, column = error.context_mark.line, error.context_mark.column
    return Diagnostic(source.span(line, column, line, column + 1), Code.BAD_YAML, advice.what, advice.hint)


def _advice(error: yaml.MarkedYAMLError, line: str, column: int) -> _Advice:
    before, character = line[:column], line[column : column + 1]
    if character == "\t":
        return _TAB
    problem = error.problem or str(error)
    if problem in _NOT_CLOSED and character in ("[", "{") and before[-1:].strip():
        return _Advice(f"a '{character}' cannot stand in a word here", "put quotes around text with brackets in it")
    if problem == "did not find expected key" and character == "-":
        return _Advice("an item of a list stands among keys", "remove the '-', or indent the item below its key")
    if problem in ("found character that cannot start any token", "did not find expected node content") and character:
        return _Advice(f"a value cannot begin with '{character}'", "put quotes around it")
    if " ? " in before:
        return _Advice("a ':' cannot stand here", f"write `b if a else c` for `a ? b : c`; {_QUOTE_COLONS}")
    passed_on = _Advice(f"this is not YAML: {problem}" + (f" {error.context}" if error.context else ""))
    return _ADVICE.get(problem, passed_on)


def _bare_line(source: Source, line: int) -> int | None:
    """The line, or the one before it, that lacks the ': ' which makes it a key."""
    before = [number for number in range(line) if _text(source, number)][-1:]
    for number in (line, *before):
        text = _text(source, number)
        if not text or _SEPARATOR.search(text):
            continue
        is_above = number < line and _keys_at(source, number) == _keys_at(source, line)
        if _WITHOUT_SPACE.match(text) or is_above or (number < line and text.strip().isidentifier()):
            return number
    return None


def _without_colon(source: Source, line: int) -> Diagnostic:
    text = source.lines[line]
    if match := _WITHOUT_SPACE.match(text):
        span = source.span(line, match.end() - 1, line, match.end())
        return Diagnostic(span, Code.BAD_YAML, "a space is missing after ':'", f"write `{_spaced(text.strip())}`")
    column = _keys_at(source, line)
    return Diagnostic(source.span(line, column, line, column + 1), Code.BAD_YAML, _NO_COLON.what)


def _spaced(text: str) -> str:
    name, _, value = text.partition(":")
    return f"{name}: {value}"


def _neighbours(source: Source, line: int) -> list[int]:
    """How far the keys and items above that could go on in this line are indented; empty if it is one of them."""
    if line >= len(source.lines):
        return []
    own, open_at = _indent(source.lines[line]), list[int]()
    for number in reversed(range(line)):
        if _text(source, number):
            at = {_keys_at(source, number), _indent(source.lines[number])}
            open_at += sorted((each for each in at if not open_at or each < open_at[-1]), reverse=True)
    if own in open_at:
        return []
    return [*[each for each in open_at if each > own][-1:], *[each for each in open_at if each < own][:1]]


def _misplaced(source: Source, line: int, neighbours: list[int]) -> Diagnostic:
    own = _indent(source.lines[line])
    if (odd := _odd_line_above(source, line)) is not None:
        line, own, neighbours = odd, _indent(source.lines[odd]), [own]
    spaces = f"{own} space{'s' * (own != 1)}"
    what = f"this line is indented by {spaces}, its neighbours by {' or '.join(map(str, neighbours))}"
    hint = "indent the keys of one mapping alike, and the items of one list"
    return Diagnostic(source.span(line, own, line, own + 1), Code.BAD_YAML, what, hint)


def _odd_line_above(source: Source, line: int) -> int | None:
    """The one line that is indented by a space more or less than this line and the next one; None without."""
    own = _indent(source.lines[line])
    written = [(number, _indent(text)) for number, text in enumerate(source.lines) if _text(source, number)]
    if own != next((indent for number, indent in written if number > line and indent <= own), None):
        return None
    for near in (own + 1, own - 1):
        odd = list[int]()
        for number, indent in reversed(written):
            if number < line and indent < min(own, near):
                break
            odd += [number] if number < line and indent == near else []
        if len(odd) == 1:
            return odd[0]
    return None


def _text(source: Source, line: int) -> str:
    """The line without its comment; empty where there is nothing else."""
    text = _COMMENT.sub("", source.lines[line]).rstrip() if line < len(source.lines) else ""
    return text if text.strip() else ""


def _keys_at(source: Source, line: int) -> int:
    """How far in the first key of a line stands; the dash of an item counts as indentation."""
    text = source.lines[line]
    return len(text) - len(text.lstrip(" -"))


def _indent(text: str) -> int:
    return len(text) - len(text.lstrip(" "))


# Comments


_EXPRESSIONS = ("fields", "send", "when", "for_each", "by", "count", "order")
"""Keys of routes below which expressions stand."""
_REST = re.compile(r"\s+#\s*(?:[-+*/%<>]\s*\w[\w.]*|\d+(?:\.\d*)?(?:e-?\d+)?)\s*")


def cut_findings(root: MappingNode, sources: Sequence[Source]) -> Iterator[Diagnostic]:
    """A warning for each expression of the routes before a comment that is only a number, or an operator and a word."""
    lines = {source.file: source.lines for source in sources}
    for node in _expressions(root.get("routes"), is_expression=False):
        span = node.span
        comment = lines[span.file][span.line - 1][span.end_column - 1 :] if node.place.is_whole_line else ""
        if _REST.fullmatch(comment):
            what = f"the comment '{comment.strip()}' is no part of the expression before it"
            hint = "write an operator in place of '#', or say in the comment what it is about"
            yield Diagnostic(span, Code.CUT_EXPRESSION, what, hint)


def _expressions(node: Node | None, *, is_expression: bool) -> Iterator[ScalarNode]:
    if isinstance(node, ScalarNode):
        if is_expression:
            yield node
    elif isinstance(node, SequenceNode):
        for item in node.items:
            yield from _expressions(item, is_expression=is_expression)
    elif isinstance(node, MappingNode) and not is_text(node):
        for key, entry in node.entries.items():
            yield from _expressions(entry.value, is_expression=is_expression or key in _EXPRESSIONS)
