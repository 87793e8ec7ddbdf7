"""What PyYAML says about text that is not YAML, in words that say what to do, at the line that has the mistake.

Knows libyaml's sentences; one that is not listed here is passed on as it is.
"""

from __future__ import annotations

import re
from typing import NamedTuple

import yaml

from router.errors import Code, Diagnostic, SourceSpan
from router.table.source import Source


class _Sentence(NamedTuple):
    """`at_start` blames the place where the thing that went wrong began, not the place where it was noticed."""

    what: str
    hint: str = ""
    at_start: bool = False


_TAB = _Sentence("a tab indents this line", "indent with spaces")
_OPEN_QUOTE = _Sentence("this quote is not closed in its line", at_start=True)
_NO_COLON = _Sentence("this line has a key without ':'", at_start=True)
_SENTENCES = {
    "did not find expected ',' or ']'": _Sentence(
        "this '[' is not closed by a ']', or a ',' is missing inside", at_start=True
    ),
    "did not find expected ',' or '}'": _Sentence(
        "this '{' is not closed by a '}', or a ',' is missing inside", at_start=True
    ),
    "found unexpected end of stream": _OPEN_QUOTE,
    "found unexpected document indicator": _OPEN_QUOTE,
    "found unknown escape character": _Sentence(
        "this backslash sequence does not exist", "single quotes take backslashes as they are"
    ),
    "mapping values are not allowed in this context": _Sentence(
        "a ':' cannot stand here", "indent keys of one mapping alike; quote text that has ': ' in it"
    ),
    "could not find expected ':'": _NO_COLON,
    "did not find expected key": _Sentence(
        "no key begins here", "indent keys of one mapping alike; quote text that has special characters in it"
    ),
    "did not find expected '-' indicator": _Sentence(
        "this line does not begin with '-' as its neighbours do", "indent what belongs to the item above"
    ),
    "block sequence entries are not allowed in this context": _Sentence(
        "a '-' cannot begin an item here", "items of a sequence begin on lines of their own"
    ),
    "did not find expected node content": _Sentence("a value is missing here"),
    "did not find expected <document start>": _Sentence(
        "this line is indented less than the first key", "indent keys of one mapping alike"
    ),
    "found incompatible YAML document": _Sentence("this is a YAML version that is not understood", "remove the line"),
}
_NOT_CLOSED = ("did not find expected ',' or ']'", "did not find expected ',' or '}'")
_FOLLOW_A_BARE_WORD = ("mapping values are not allowed in this context", "did not find expected key")
_COMMENT = re.compile(r"(?:^|\s)#.*")


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
    sentence = _sentence(error, source, line, column)
    if open_quote:
        return Diagnostic(open_quote, Code.BAD_YAML, _OPEN_QUOTE.what)
    if open_bracket and not any(text.strip() for text in source.lines[line:]):
        return Diagnostic(open_bracket.part(0, 1), Code.BAD_YAML, "this bracket is never closed")
    if error.problem in _FOLLOW_A_BARE_WORD and (bare := _line_without_colon(source, line)) is not None:
        line, column = bare, _indent(source.lines[bare])
        sentence = _NO_COLON
    elif sentence.at_start and error.context_mark:
        line, column = error.context_mark.line, error.context_mark.column
    return Diagnostic(source.span(line, column, line, column + 1), Code.BAD_YAML, sentence.what, sentence.hint)


def _sentence(error: yaml.MarkedYAMLError, source: Source, line: int, column: int) -> _Sentence:
    character = source.lines[line][column : column + 1] if line < len(source.lines) else ""
    if character == "\t":
        return _TAB
    problem = error.problem or str(error)
    if problem in _NOT_CLOSED and character in ("[", "{") and source.lines[line][:column][-1:].strip():
        return _Sentence(f"a '{character}' cannot stand in a word here", "put quotes around text with brackets in it")
    if problem == "found character that cannot start any token":
        return _Sentence(f"a value cannot begin with '{character}'", "put quotes around it")
    passed_on = _Sentence(f"this is not YAML: {problem}" + (f" {error.context}" if error.context else ""))
    return _SENTENCES.get(problem, passed_on)


def _line_without_colon(source: Source, line: int) -> int | None:
    """The line before `line` if it is indented alike and lacks the ':' that makes it a key."""
    before = line - 1
    while before >= 0 and not _COMMENT.sub("", source.lines[before]).strip():
        before -= 1
    if before < 0 or _indent(source.lines[before]) != _indent(source.lines[line]):
        return None
    return None if ":" in _COMMENT.sub("", source.lines[before]) else before


def _indent(text: str) -> int:
    """How far in the first key of a line stands; the dash of an item counts as indentation."""
    return len(text) - len(text.lstrip(" -"))
