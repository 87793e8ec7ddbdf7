"""YAML text to nodes: PyYAML's parser events, composed without recursion and with bounds.

Plain scalars follow the core schema of YAML 1.2. Text that cannot be parsed raises TableError, which points at the
mistake and says what to do. Other problems become findings, and their nodes are marked broken.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import yaml

from router.errors import Code, Diagnostic, SourceSpan, TableError, nearest
from router.table.nodes import (
    REASONS,
    SAY_WHY,
    Entry,
    MappingNode,
    Node,
    Plain,
    ScalarNode,
    SequenceNode,
    TextSpan,
    cut_off,
    locate,
)
from router.table.source import Source, fill, foreign_blank, has_variables, unusable_character

MAX_DEPTH = 32
MOST_REPEATED = 20_000
"""Values that all aliases of a file repeat: a few lines of nested ones can stand for billions."""

LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # libyaml's if this PyYAML was built with it


@dataclass(slots=True)
class _Collection:
    """A mapping or sequence that is still open. A mapping's children are key, value, key, value."""

    event: yaml.CollectionStartEvent
    span: SourceSpan
    broken: bool
    children: list[Node] = field(default_factory=list)
    size: int = 1


def compose(source: Source, environ: Mapping[str, str], findings: list[Diagnostic]) -> Node:
    """Compose the only document of the text. Non-fatal findings are appended to `findings`."""
    return _Composer(source, environ, findings).compose()


class _Composer:
    def __init__(self, source: Source, environ: Mapping[str, str], findings: list[Diagnostic]) -> None:
        self._source = source
        self._environ = environ
        self._findings = findings
        self._open: list[_Collection] = []
        self._anchors: dict[str, tuple[Node, int]] = {}
        self._repeated = 0
        self._root: Node | None = None

    def compose(self) -> Node:
        for event in self._events():
            if isinstance(event, yaml.ScalarEvent):
                self._add(self._scalar(event), 1, event.anchor)
            elif isinstance(event, yaml.CollectionStartEvent):
                self._begin(event)
            elif isinstance(event, yaml.CollectionEndEvent):
                closed = self._open.pop()
                self._add(self._closed(closed), closed.size, closed.event.anchor)
            elif isinstance(event, yaml.AliasEvent):
                self._alias(event)
            elif isinstance(event, yaml.DocumentStartEvent) and self._root is not None:
                raise self._fatal(self._span(event), "a second document begins here", "write one document per file")
        if self._root is None or (isinstance(self._root, ScalarNode) and not self._root.text):
            raise self._fatal(SourceSpan(self._source.file), "the file contains no table", "start with 'version: 1'")
        return self._root

    def _events(self) -> Iterator[yaml.Event]:
        last: yaml.Event | None = None  # with text: an unclosed quote is parsed as a key without a value
        try:
            for event in yaml.parse(self._source.text, Loader=LOADER):
                if not isinstance(event, yaml.ScalarEvent) or event.value or event.style:
                    last = event
                yield event
        except yaml.MarkedYAMLError as error:
            from router.table.yaml_errors import explain

            raise TableError([explain(error, self._source, self._open_quote(last), self._open_bracket())]) from error
        except (yaml.YAMLError, ValueError, OverflowError) as error:  # the last two: escapes, pure Python parser
            raise self._fatal(SourceSpan(self._source.file), f"this is not YAML: {error}", "") from error

    def _open_quote(self, event: yaml.Event | None) -> SourceSpan | None:
        """Return where a multi-line quoted scalar begins, if that is the last event."""
        if not isinstance(event, yaml.ScalarEvent) or event.style not in ("'", '"'):
            return None
        line, column, end_line, _ = _marks(event)
        return self._source.span(line, column, line, column + 1) if end_line > line else None

    def _open_bracket(self) -> SourceSpan | None:
        """Return the position of the innermost open '[' or '{'."""
        flow = [collection for collection in self._open if collection.event.flow_style]
        return flow[-1].span if flow else None

    def _begin(self, event: yaml.CollectionStartEvent) -> None:
        span = self._span(event)
        if len(self._open) == MAX_DEPTH:
            raise self._fatal(span, f"this is nested more than {MAX_DEPTH} levels deep", "")
        if event.anchor is not None:
            self._anchors.pop(event.anchor, None)
        self._open.append(_Collection(event, span, self._has_tag(event, span)))

    def _alias(self, event: yaml.AliasEvent) -> None:
        if event.anchor not in self._anchors:
            recursive = any(collection.event.anchor == event.anchor for collection in self._open)
            problem = "is inside the value that it repeats" if recursive else "has no anchor above it"
            what = f"the alias '*{event.anchor}' {problem}"
            raise self._fatal(
                self._span(event), what, "write out the value" if recursive else self._anchor_hint(event.anchor or "")
            )
        node, size = self._anchors[event.anchor]
        self._repeated += size
        if self._repeated > MOST_REPEATED:
            raise self._fatal(self._span(event), f"aliases repeat more than {MOST_REPEATED} values of this file", "")
        self._add(node, size, None)

    def _anchor_hint(self, name: str) -> str:
        if near := nearest(name, self._anchors):
            return f"did you mean '*{near}'?"
        if re.search(rf"&{re.escape(name)}(?!\S)", self._source.text):
            return f"move the value with '&{name}' above the first '*{name}'"
        return f"write '&{name}' before the value that it repeats, in this file; quote text that begins with '*'"

    def _add(self, node: Node, size: int, anchor: str | None) -> None:
        if anchor is not None:
            self._anchors[anchor] = node, size
        if not self._open:
            self._root = node
            return
        parent = self._open[-1]
        parent.children.append(node)
        parent.size += size

    def _scalar(self, event: yaml.ScalarEvent) -> ScalarNode:
        span = self._span(event)
        text_span = self._text_span(event, span)
        broken = self._has_tag(event, span)
        text = event.value
        if is_filled := has_variables(text):
            text, problems = fill(text, self._environ)
            for problem in problems:
                part = text_span.part(problem.start, problem.end)
                self._findings.append(Diagnostic(part, problem.code, problem.message, problem.hint))
            broken |= bool(problems)
            text_span = TextSpan(span)
        if unusable := unusable_character(text):
            broken |= self._report(span, f"the text contains the character {unusable[1]}", "remove it")
        if not event.style and text[-1:] == "," and " " not in text and self._open_bracket() is None:
            broken |= self._report(
                span, f"'{text}' ends with a ','", "remove it: ',' separates values only inside brackets"
            )
        if event.style or broken:
            return ScalarNode(span, text, text, text_span, broken, is_filled)
        if odd := surprise(text):
            # Shows a variable by name, since its value may be secret.
            what = f"some YAML parsers read '{event.value}' as {odd.meaning}, others do not"
            remedy = f"{odd.remedy}; for text, " if odd.remedy and not self._is_key() else ""
            hint = f'{remedy}quote it: "{event.value}"'
            if (key := self._key()) in REASONS and truth_of(text) is not None:
                hint = SAY_WHY.format(key)
            self._findings.append(Diagnostic(span, Code.AMBIGUOUS_SCALAR, what, hint))
            broken = True
        return ScalarNode(span, text, resolve(text), text_span, broken, is_filled)

    def _is_key(self) -> bool:
        """Return whether the next node is a key of a mapping."""
        parent = self._open[-1] if self._open else None
        return parent is not None and isinstance(parent.event, yaml.MappingStartEvent) and not len(parent.children) % 2

    def _key(self) -> str:
        """Return the key whose value the next node is; empty if there is none."""
        parent = self._open[-1] if self._open and not self._is_key() else None
        key = parent.children[-1] if parent and isinstance(parent.event, yaml.MappingStartEvent) else None
        return key.text if isinstance(key, ScalarNode) else ""

    def _text_span(self, event: yaml.ScalarEvent, span: SourceSpan) -> TextSpan:
        line, first, end_line, last = _marks(event)
        if not event.style and event.value and event.value == self._source.lines[line][first:last]:
            return TextSpan(span, ((0, span),))
        if event.style in ("'", '"'):
            first, last = first + 1, last - 1
        elif event.style in ("|", ">"):
            line, first = line + 1, 0  # the text begins below its header
        pieces = []
        for number, written in enumerate(self._source.lines[line : end_line + 1], line):
            start = first if number == line else 0
            pieces.append((number + 1, start + 1, written[start : last if number == end_line else None]))
        return locate(event.value, span, pieces)

    def _closed(self, collection: _Collection) -> Node:
        if isinstance(collection.event, yaml.SequenceStartEvent):
            return SequenceNode(collection.span, tuple(collection.children), collection.broken)
        entries: dict[str, Entry] = {}
        broken = collection.broken
        pairs = list(zip(collection.children[::2], collection.children[1::2], strict=True))
        rests = set(cut_off((key.text, value) for key, value in pairs if isinstance(key, ScalarNode)))
        for written, value in pairs:
            key = written if isinstance(written, ScalarNode) and written.text in rests else self._without_slip(written)
            if not isinstance(key, ScalarNode):
                broken = self._report(
                    key.span,
                    "a key must be a word, not a mapping or a list",
                    "quote text that begins with '{' or '['",
                )
            elif blank := foreign_blank(key.text):
                broken = self._report(
                    key.span, f"this key contains the character {blank}", "remove it, or write an ordinary space"
                )
            elif key.text == "<<" and key.value == "<<":
                broken = self._report(key.span, "tables do not support merge keys ('<<')", "write out the keys")
            elif key.text in entries and key.text in rests:
                continue  # already has a finding
            elif key.text in entries:
                first = entries[key.text].key.span
                what = f"the key '{key.text}' is already in this mapping, on line {first.line}"
                self._findings.append(Diagnostic(key.span, Code.DUPLICATE_KEY, what, "remove one of the two"))
            else:
                entries[key.text] = Entry(key, value)
        return MappingNode(collection.span, entries, broken)

    def _without_slip(self, key: Node) -> Node:
        """Return the key that is meant, and report a finding if it is misspelt."""
        if isinstance(key, ScalarNode) and key.text_span.is_whole_line:
            for pattern, what, hint in _KEY_SLIPS:
                if match := pattern.fullmatch(key.text):
                    self._report(key.text_span.part(*match.span("slip")), what, hint)
                    return replace(key, text=match["key"], value=match["key"])
        return key

    def _has_tag(self, event: yaml.ScalarEvent | yaml.CollectionStartEvent, span: SourceSpan) -> bool:
        if event.tag is None:
            return False

        from router.table.yaml_errors import exclamation

        name = event.tag.replace("tag:yaml.org,2002:", "!!")
        hint = "remove it; to make a value text, quote it"
        if "include" in name:
            hint = "put what tables share into one table, which the others name in `extends: FILE`"
        if (finding := exclamation(self._source, span.line - 1)) is not None:
            self._findings.append(finding)
            return True
        return self._report(span, f"tables do not support the tag '{name}'", hint)

    def _report(self, span: SourceSpan, what: str, hint: str) -> bool:
        """Add a finding. Return True, the value of `broken` for its node."""
        self._findings.append(Diagnostic(span, Code.BAD_YAML, what, hint))
        return True

    def _span(self, event: yaml.Event) -> SourceSpan:
        return self._source.span(*_marks(event))

    def _fatal(self, span: SourceSpan, what: str, hint: str) -> TableError:
        return TableError.of(span, Code.BAD_YAML, what, hint)


def _marks(event: yaml.Event) -> tuple[int, int, int, int]:
    """Return line and column of the first character and of the end, from 0."""
    start, end = event.start_mark, event.end_mark
    if start is None or end is None:
        raise TypeError("the parser sets marks on every event")
    return start.line, start.column, end.line, end.column


_KEY_SLIPS = (
    (re.compile(r"(?P<key>.*?[^\s:])\s*(?P<slip>:+)"), "unexpected ':'", "remove it"),
    (
        re.compile(r"(?P<slip>-)(?P<key>[A-Za-z_][\w.]*)"),
        "a space is missing after '-'",
        "start list items with '- '; a key has no '-'",
    ),
)
"""Characters that a plain key ends or begins with by mistake: a pattern, what is wrong, and what to do."""

# Plain scalars

_WORDS: dict[str, Plain] = {
    **dict.fromkeys(("", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
}
_INT = re.compile(r"[-+]?[0-9]{1,300}")  # Python does not parse far longer ones
_HEX = re.compile(r"0x[0-9a-fA-F]{1,300}")
_FLOAT = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")


class Surprise(NamedTuple):
    """How some YAML parsers interpret a scalar, and how to write it unambiguously."""

    meaning: str
    remedy: str


_NUMBERS = frozenset("0123456789+-.")
"""First characters of numbers; nearly all other scalars begin differently."""
_OCTAL = Surprise("an octal number", "write a decimal number without leading zeros")
_BINARY = Surprise("a binary number", "write a decimal number")
_HEXADECIMAL = Surprise("a hexadecimal number", "write a decimal number")
_TRUTHS = {"yes": True, "on": True, "no": False, "off": False}
_GROUPED = Surprise("a number", "leave out the '_'")
_WORD_SURPRISES: dict[str, Surprise] = {
    **{
        spelling: Surprise("a truth value", f"write {'true' if truth else 'false'}")
        for word, truth in _TRUTHS.items()
        for spelling in (word, word.title(), word.upper())
    },
    "~": Surprise("an empty value", "leave the key out, or in a route write {ignore: why}"),
}
_NUMBER_SURPRISES = (
    (re.compile(r"[-+]?0[0-9_]+|0o[0-7]+"), _OCTAL),
    (re.compile(r"[-+]?0b[01_]+"), _BINARY),
    (re.compile(r"[-+]0x[0-9a-fA-F_]+|0x(?=.*_)[0-9a-fA-F_]+"), _HEXADECIMAL),
    (re.compile(r"[-+]?[0-9][0-9_]*(?::[0-5]?[0-9])+(?:\.[0-9_]*)?"), Surprise("a number in base 60", "")),
    (
        re.compile(r"[0-9]{4}-[0-9]{1,2}-[0-9]{1,2}(?:(?:[Tt]|[ \t]+)[0-9]{1,2}:[0-9:.]+[ \t]*[-+:0-9Z]*)?"),
        Surprise("a date", ""),
    ),
    (re.compile(r"(?=.*_)[-+]?(?:[0-9][0-9_]*(?:\.[0-9_]*)?|\.[0-9][0-9_]*)(?:[eE][-+]?[0-9]+)?"), _GROUPED),
)


def truth_of(text: str) -> bool | None:
    """Return what YAML 1.1 reads a word as, such as `yes`; None for anything that is not a truth value."""
    return _TRUTHS.get(text.lower())


def resolve(text: str) -> Plain:
    """Return the value of a plain scalar. Tables have no infinities or NaN: `.inf` and `1e999` stay text."""
    if text in _WORDS:
        return _WORDS[text]
    if text[0] not in _NUMBERS:
        return text
    if _INT.fullmatch(text):
        return int(text)
    if _HEX.fullmatch(text):
        return int(text, 16)
    if _FLOAT.fullmatch(text) and math.isfinite(number := float(text)):
        return number
    return text


def surprise(text: str) -> Surprise | None:
    """Return how YAML 1.1 interprets a plain scalar differently from YAML 1.2; None if it does not."""
    if text[:1] not in _NUMBERS:
        return _WORD_SURPRISES.get(text)
    return next((odd for pattern, odd in _NUMBER_SURPRISES if pattern.fullmatch(text)), None)
