"""Findings for mistakes in YAML, at the line with the mistake, with a remedy.

`explain` handles syntax errors. `cut_findings` handles one mistake that is valid YAML: a comment that looks like the
rest of an expression, as in `x # 1000`.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import yaml

from router.errors import Code, Diagnostic, SourceSpan, plural
from router.table.nodes import MappingNode, Node, ScalarNode, SequenceNode
from router.table.reading import is_text
from router.table.schema import is_misplaced
from router.table.source import Source


class _Advice(NamedTuple):
    """What is wrong and what to do. With `at_start`, the finding points at the beginning of the construct."""

    what: str
    hint: str = ""
    at_start: bool = False


_TAB = _Advice("this line is indented with a tab", "indent with spaces")
_OPEN_QUOTE = _Advice("this quote is not closed on its line", at_start=True)
_UNENDING = "found unexpected end of stream"
_NO_KEY_ENDS = "could not find expected ':'"
_NO_KEY = "did not find expected key"
_NO_DASH = "did not find expected '-' indicator"
_NO_DOCUMENT = "did not find expected <document start>"
_NOT_CLOSED = {
    "did not find expected ',' or ']'": ("[", "]"),
    "did not find expected ',' or '}'": ("{", "}"),
}
_BETWEEN_KEYS = (_NO_KEY, _NO_DASH, _NO_DOCUMENT)
_ITEM_AMONG_KEYS = "this list item is among the keys of a mapping"
_QUOTE_COLONS = "quote text that contains ': '"
_ADVICE = {
    **{
        problem: _Advice(f"this '{opening}' is not closed by a '{closing}', or a ',' is missing inside", at_start=True)
        for problem, (opening, closing) in _NOT_CLOSED.items()
    },
    "found unexpected document indicator": _OPEN_QUOTE,
    "found unknown escape character": _Advice(
        "unknown backslash sequence", "use single quotes, which keep backslashes as they are"
    ),
    "mapping values are not allowed in this context": _Advice(
        "a ':' is not allowed here", f"{_QUOTE_COLONS}; start each key of a mapping on its own line"
    ),
    "found unexpected ':'": _Advice("a ':' is not allowed here", "remove it, or quote the text that contains it"),
    _NO_KEY: _Advice("a key is expected here", "quote text that contains special characters"),
    _NO_DASH: _Advice(
        "this line does not start with '-' as its neighbours do",
        "start an item with '- ', or indent what belongs to the item above",
    ),
    "block sequence entries are not allowed in this context": _Advice(
        "a list item cannot start here", "start each list item on its own line"
    ),
    "did not find expected node content": _Advice("a value is missing here"),
    _NO_DOCUMENT: _Advice("this line is indented less than the first key", "indent all keys of a mapping equally"),
    "found incompatible YAML document": _Advice("this YAML version is not supported", "remove the line"),
}
_NO_BEGINNING = (
    "found character that cannot start any token",
    "did not find expected node content",
    "mapping keys are not allowed in this context",
    "did not find expected comment or line break",
    "did not find expected alphabetic or numeric character",
    "did not find expected whitespace or line break",
)
"""Problems with the first character of a value. The last three are detected after it."""
_UNBEGUN = {
    ",": _Advice("a value is missing before this ','", "remove the ','"),
    "-": _Advice("an item in brackets does not start with '-'", "remove the '-', or the brackets"),
}
_COMMENT_SIGN = _Advice("a comment starts with '#'", "replace this with '#'")
_SLIPS = (
    (
        re.compile(r"(<{7}|={7}|>{7}|\|{7})(?: |$)"),
        _Advice("unresolved merge conflict", "keep one version, and remove '<<<<<<<', '=======' and '>>>>>>>'"),
    ),
    (re.compile(r" *(//|/\*|--(?!\S))"), _COMMENT_SIGN),
    (re.compile(r" *(-)[A-Za-z_]"), _Advice("a space is missing after '-'", "start list items with '- '")),
)
"""Beginnings of lines that are always mistakes. YAML often fails only on the next line."""
_AFTER_VALUE = (
    (re.compile(r"//|/\*|--(?!\S)"), _COMMENT_SIGN),
    (
        re.compile(r"""(?<=["'])\w"""),
        _Advice("the quoted text ends before this", "put the other kind of quotes around the text"),
    ),
    (
        re.compile(r"[-+*/%<>=!&|.(?]|(?:if|else|and|or|in|is|not)\b"),
        _Advice("the value ends before this", "quote the whole expression, as in \"'gps_' + str(index)\""),
    ),
)
"""Text after a quoted or bracketed value that looks like a continuation of it."""
_CUT_CALL = re.compile(r"\w\([^()]*,[^()]*$")
"""The beginning of a call whose arguments a ',' separates."""
_FOREIGN = re.compile(
    r"(?:^|[-:,?{}\[\]])\s*?(?P<at_start>[^\S \t]|[\u200b-\u200d\u2060\u2013\u2014\u2018-\u201f])"
    r"|(?<=[!-~])(?P<inside>[\uff0c\uff1a\uff1b\uff3b\uff3d\uff5b\uff5d])"
)
"""Typographic spaces, quotes and dashes where a value or key begins; full-width signs after ASCII characters."""
_ASCII = str.maketrans("\u2013\u2014\u2018\u2019\u201c\u201d", "--''\"\"")
_IPV6 = re.compile(
    r"(?<![^\s,\[{])(?:(?:[a-z]+/)?\[[0-9A-Fa-f]*:[0-9A-Fa-f:.]*(?:%[\w.-]+)?\]:\d+|::[0-9A-Fa-f:.]*(?:/\d+)?"
    r"|[0-9A-Fa-f:]+::(?![^\s,\]}]))"
)
"""IPv6 addresses with a bracket, or with a ':' at the beginning or end."""
_HIDDEN = re.compile(r"""(?<!\w)("(?:\\.|[^"\\])*"|'(?:''|[^'])*')|(?:^|(?<=[ \t]))#.*""")
_SEPARATOR = re.compile(r":(?=[ \t]|$)")
_WITHOUT_SPACE = re.compile(r"[ -]*[A-Za-z_]\w*:(?=\S)")
_WITHOUT_COLON = re.compile(r"(?!(?:if|else|and|or|not|in)\b)([\w./]+)(?: *[=:]>? *(.+)| +(\S+))?")
_IN_WORDS = re.compile(r"[{,] *(?P<key>none|ignore|because): +(?P<text>[^\"',{}\[\]:][^,{}\[\]]*)$")
"""A reason in prose that contains a ':'."""
_WITHOUT_COMMA = re.compile(r"[:,{\[] *([^\s,;:]+);? +([\w.]+) *$")


def explain(
    error: yaml.MarkedYAMLError, source: Source, open_quote: SourceSpan | None, open_bracket: SourceSpan | None
) -> Diagnostic:
    """Return the finding for a syntax error.

    `open_quote` is the start of the quoted scalar before the error, if it spans several lines: its closing quote is
    then most likely the opening quote of the next one. `open_bracket` is the innermost bracket around the error. If the
    text ends inside it, its closing bracket is missing.
    """
    line = error.problem_mark.line if error.problem_mark else 0
    column = error.problem_mark.column if error.problem_mark else 0
    if open_quote:
        return Diagnostic(open_quote, Code.BAD_YAML, _OPEN_QUOTE.what)
    if slip := _slip(source, line) or exclamation(source, line) or _ipv6(source, line, column):
        return slip
    if error.problem == _UNENDING and error.context_mark:
        return _finding(source, error.context_mark.line, error.context_mark.column, _OPEN_QUOTE)
    if open_bracket and not any(text.strip() for text in source.lines[line:]):
        return Diagnostic(open_bracket.part(0, 1), Code.BAD_YAML, "this bracket is never closed")
    written = source.lines[line] if line < len(source.lines) else ""
    start = error.context_mark
    if not open_bracket and (shallow := _too_shallow(source, line)) is not None:
        return shallow
    if not open_bracket and written[column : column + 1] != "\t":
        begun = start.line if error.problem == _NO_KEY_ENDS and start else None
        if (bare := _bare_line(source, line) if begun is None else begun) is not None:
            return _without_colon(source, bare)
        if (neighbours := _neighbours(source, line)) and not _SEPARATOR.search(written[:column]):
            return _misplaced(source, line, neighbours)
    advice = _advice(error, source, line, column)
    if advice.at_start and start:
        line, column = start.line, start.column
    return _finding(source, line, column, advice)


def _finding(source: Source, line: int, column: int, advice: _Advice) -> Diagnostic:
    return Diagnostic(source.span(line, column, line, column + 1), Code.BAD_YAML, advice.what, advice.hint)


_EXCLAMATION = re.compile(
    r"(?:^|[:,\[{]) *(?:- +)*(?P<all>! ?(?P<what>\(|[A-Za-z_][\w.]*(?:\(|(?= *(?:[,}\]<>=]|$|(?:and|or|if)\b)))))"
)
_NO_EXCLAMATION = "a value cannot start with '!'"


def exclamation(source: Source, line: int) -> Diagnostic | None:
    """Return a finding for `!(a > b)`, which means `not` in other languages, or None."""
    for number in (line, *_line_before(source, line)):
        text = source.lines[number] if number < len(source.lines) else ""
        if match := _EXCLAMATION.search(text):
            start, end = match.start("what"), match.end("what")
            end = _closing(text, end) if match["what"].endswith("(") else end
            span = source.span(number, match.start("all"), number, end)
            return Diagnostic(span, Code.BAD_YAML, _NO_EXCLAMATION, f"write `not {text[start:end]}`")
    return None


def _closing(text: str, start: int) -> int:
    """Return where the bracket that is open at `start` closes; the end of the text if it does not."""
    opened = 1
    for at, character in enumerate(text[start:], start):
        opened += (character == "(") - (character == ")")
        if opened == 0:
            return at + 1
    return len(text.rstrip())


def _slip(source: Source, line: int) -> Diagnostic | None:
    """Return a finding for text in the line, or in the one before it, that YAML does not allow, or None."""
    for number in (*_line_before(source, line), line):
        text = _text(source, number)
        for pattern, advice in _SLIPS:
            if match := pattern.match(text):
                return _finding(source, number, match.start(1), advice)
        if match := _FOREIGN.search(text):
            character = match[match.lastgroup or 0]
            plain = unicodedata.normalize("NFKC", character.translate(_ASCII))
            name = unicodedata.name(character, "").lower()
            what = f"the character U+{ord(character):04X} ({name}) is not allowed here"
            quote = '"' if plain == "'" else "'"
            hint = f"replace it with {quote}{plain}{quote}" if plain.isascii() else "remove it"
            return _finding(source, number, match.start(match.lastgroup or 0), _Advice(what, hint))
    return None


def _ipv6(source: Source, line: int, column: int) -> Diagnostic | None:
    """Return a finding for an IPv6 address without quotes at or before a column, or None."""
    for match in _IPV6.finditer(_text(source, line)):
        if match.start() <= column <= match.end():
            span = source.span(line, match.start(), line, match.end())
            return Diagnostic(span, Code.BAD_YAML, "an IPv6 address needs quotes here", f'write "{match[0]}"')
    return None


def _advice(error: yaml.MarkedYAMLError, source: Source, line: int, column: int) -> _Advice:
    written = source.lines[line] if line < len(source.lines) else ""
    before, character = written[:column], written[column : column + 1]
    problem, start = error.problem or str(error), error.context_mark
    if character == "\t":
        return _TAB
    if problem in _NOT_CLOSED and character == "{" and before.endswith("$"):
        return _Advice("a '${' is not allowed inside brackets", f"quote it: {_quoted_around(written, column)}")
    if problem in _NOT_CLOSED and character in ("[", "{") and before[-1:].strip():
        return _Advice(f"a '{character}' is not allowed inside a word here", "quote text that contains brackets")
    if problem in _NOT_CLOSED and start and start.line != line and (character in ":]}" or not before.strip()):
        return _ADVICE[problem]._replace(hint=f"add what is missing before line {line + 1}")
    if character == ":" and (advice := _colon(problem, before, written[column + 1 :])):
        return advice
    begun = start.column if start and start.line == line else column
    if problem in _NO_BEGINNING and begun < len(written):
        return _no_beginning(written, begun)
    if problem == _NO_KEY and character == "-" and not before.strip():
        return _Advice(_ITEM_AMONG_KEYS, "remove the '-', or indent the item below its key")
    if problem == _NO_DASH and start and _is_only_item(source, start.line, line):
        keys = _keys_at(source, start.line)
        what = f"this line is indented like the '-' above; the keys of that item are indented by {keys}"
        return _Advice(what, f"indent it by {keys} spaces, or remove the '-' on line {start.line + 1}")
    if problem in _NOT_CLOSED or (problem in _BETWEEN_KEYS and before.strip()):
        return _behind_value(written, column, _NOT_CLOSED.get(problem, ("", ""))[1])
    passed_on = _Advice(f"this is not YAML: {problem}" + (f" {error.context}" if error.context else ""))
    return _ADVICE.get(problem, passed_on)


_WORD_WITH_VARIABLES = re.compile(r"(?:\$\{[^}]*\}|[^\s,{}\[\]])+")


def _quoted_around(written: str, column: int) -> str:
    """Return the word around a column, with variables, in quotes."""
    words = (match for match in _WORD_WITH_VARIABLES.finditer(written) if match.end() > column)
    return f'"{next(words, ("NAME",))[0]}"'


def _colon(problem: str, before: str, after: str) -> _Advice | None:
    if " ? " in before:
        return _Advice("a ':' is not allowed here", f"write `b if a else c` for `a ? b : c`; {_QUOTE_COLONS}")
    if problem in _NOT_CLOSED and (said := _IN_WORDS.search(before)):
        rest = re.match(r"[^,}\]]*", after)
        text = f"{said['text']}:{rest[0] if rest else ''}".replace('"', "'").rstrip()
        return _Advice("a ':' is not allowed here", f'{_QUOTE_COLONS}: `{said["key"]}: "{text}"`')
    if problem in _NOT_CLOSED and (words := _WITHOUT_COMMA.search(before)):
        return _Advice(f"a ',' is missing before '{words[2]}'", f"write `{words[1]}, {words[2]}:`")
    if problem in _NOT_CLOSED:
        return _Advice("a ':' is not allowed here", f"{_QUOTE_COLONS}, or put braces around the inner mapping")
    if after[:1] in ("[", "{"):
        return _Advice("a space is missing after ':'", f"write `: {after[:1]}`")
    if before.rstrip().endswith(":") or (_SEPARATOR.search(before) and not _HIDDEN.sub("", after).strip()):
        return _Advice("unexpected ':'", "remove it")
    return None


def _no_beginning(written: str, column: int) -> _Advice:
    """Return advice for the first character of a value, or for one after a value that could begin another."""
    character = written[column]
    if written[:column].rstrip()[-1:] in {*"\"'])}"}:
        return _behind_value(written, column, "")._replace(at_start=True)
    return _UNBEGUN.get(character) or _Advice(
        f"a value cannot start with '{character}'", "put quotes around the value", at_start=True
    )


def _behind_value(written: str, column: int, closing: str) -> _Advice:
    """Return advice for text after a value, where only the end of the line, ',' or `closing` is allowed."""
    character = written[column : column + 1]
    for pattern, advice in _AFTER_VALUE:
        if pattern.match(written, column):
            return advice
    if closing and _CUT_CALL.search(_HIDDEN.sub(lambda match: "_" * len(match[0]), written)[:column]):
        return _Advice("a ',' inside brackets ended the value before this", "quote the whole expression")
    if closing:
        hint = f"replace it with '{closing}', or remove it" if character in ("]", "}") else ""
        return _Advice(f"a ',' or '{closing}' is missing before this", hint)
    if character and character in ")]},;":
        return _Advice(f"unexpected '{character}'", "remove it")
    if not _SEPARATOR.search(written[:column]):
        return _Advice("a ':' is missing before this")
    return _Advice("the value ends before this", "put quotes around the whole value")


def _is_only_item(source: Source, first: int, line: int) -> bool:
    """Return whether the list that begins on line `first` has one item, a mapping, and `line` is a key beside it."""
    dash = f"{' ' * _indent(source.lines[line])}-"
    items = [text for text in source.lines[first:line] if text.startswith(dash)]
    return len(items) == 1 and bool(_SEPARATOR.search(_text(source, first)))


def _line_before(source: Source, line: int) -> list[int]:
    """Return the last line before `line` that has more than a comment; empty if there is none."""
    return next(([number] for number in reversed(range(line)) if _text(source, number)), [])


def _bare_line(source: Source, line: int) -> int | None:
    """Return the line, or the one before it, if it lacks the ': ' of a key; else None."""
    for number in (line, *_line_before(source, line)):
        text = _text(source, number)
        is_above = number < line and _keys_at(source, number) == _keys_at(source, line)
        is_bare = text and not _SEPARATOR.search(text)
        if _WITHOUT_SPACE.match(text) or (is_bare and (is_above or (number < line and text.strip().isidentifier()))):
            return number
    return None


def _without_colon(source: Source, line: int) -> Diagnostic:
    text = source.lines[line]
    if match := _WITHOUT_SPACE.match(text):
        span = source.span(line, match.end() - 1, line, match.end())
        return Diagnostic(span, Code.BAD_YAML, "a space is missing after ':'", f"write `{_spaced(text.strip())}`")
    column = _keys_at(source, line)
    words = _WITHOUT_COLON.fullmatch(_text(source, line)[column:])
    hint = "indent text that continues the line above; start a comment with '#'"
    if words:
        value = words[2] or words[3] or ("true" if words[1] == "auto" else "")
        hint = f"write `{words[1]}: {value}`" if value else f"write `{words[1]}:`"
    return _finding(source, line, column, _Advice("this line has a key without ':'", hint))


def _spaced(text: str) -> str:
    name, _, value = text.partition(":")
    return f"{name}: {value}"


def _neighbours(source: Source, line: int) -> list[int]:
    """Return the indentations at which this line could continue the keys and items above; empty if it already does."""
    if line >= len(source.lines):
        return []
    own, open_at = _indent(source.lines[line]), list[int]()
    for number in reversed(range(line)):
        if _text(source, number):
            at = {_keys_at(source, number), _indent(source.lines[number])}
            open_at += sorted((indent for indent in at if not open_at or indent < open_at[-1]), reverse=True)
    if own in open_at:
        return []
    deeper, shallower = ([indent for indent in open_at if indent > own], [indent for indent in open_at if indent < own])
    return [*deeper[-1:], *shallower[:1]]


def _misplaced(source: Source, line: int, neighbours: list[int]) -> Diagnostic:
    own = _indent(source.lines[line])
    if (odd := _odd_line_above(source, line)) is not None:
        line, own, neighbours = odd, _indent(source.lines[odd]), [own]
    what = f"this line is indented by {plural(own, 'space')}, its neighbours by {' or '.join(map(str, neighbours))}"
    return _indented(source, line, what)


_KEY = re.compile(r"[ -]*([\w.]+):(?: |$)")


def _too_shallow(source: Source, line: int) -> Diagnostic | None:
    """Return a finding for a key above that is indented too little, so that this line is misplaced, or None.

    If a mapping of that depth can have such a key, this line is indented too far instead.
    """
    own = _indent(source.lines[line]) if line < len(source.lines) else 0
    above = [number for number in reversed(range(line)) if _text(source, number)]
    shallow = next((number for number in above if _keys_at(source, number) < own), None)
    key = _KEY.match(source.lines[shallow]) if shallow is not None else None
    if shallow is None or key is None:
        return None
    depth = _keys_at(source, shallow)
    before = [number for number in above if number < shallow]
    if next((_keys_at(source, number) for number in before if _keys_at(source, number) <= own), depth) != own:
        return None
    siblings = list[str]()
    for number in before:
        if _keys_at(source, number) < depth:
            break
        if _keys_at(source, number) == depth and (sibling := _KEY.match(source.lines[number])):
            siblings.append(sibling[1])
    if not is_misplaced(key[1], siblings):
        return None
    return _indented(source, shallow, f"this line is indented by {plural(depth, 'space')}, its neighbours by {own}")


def _indented(source: Source, line: int, what: str) -> Diagnostic:
    own = _indent(source.lines[line])
    hint = "indent all keys of a mapping equally, and all items of a list"
    return Diagnostic(source.span(line, own, line, own + 1), Code.BAD_YAML, what, hint)


def _odd_line_above(source: Source, line: int) -> int | None:
    """Return the only line above that is indented one space more or less than this line and the next, or None."""
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
    """Return the line without its comment, with quotes in place of quoted text; empty if nothing else is left."""
    text = source.lines[line] if line < len(source.lines) else ""
    text = _HIDDEN.sub(lambda match: '"' * len(match[1] or ""), text).rstrip(" \t")
    return text if text.strip(" ") else ""


def _keys_at(source: Source, line: int) -> int:
    """Return the column of the first key of a line; the dash of an item counts as indentation."""
    text = source.lines[line]
    return len(text) - len(text.lstrip(" -"))


def _indent(text: str) -> int:
    return len(text) - len(text.lstrip(" "))


# Comments


_EXPRESSIONS = ("fields", "send", "when", "for_each", "by", "count", "order")
"""Keys of routes whose values are expressions."""
_REST = re.compile(r"\s+#\s*(?:[-+*/%<>]\s*\w[\w.]*|\d+(?:\.\d*)?(?:e-?\d+)?)\s*")


def cut_findings(root: MappingNode, sources: Sequence[Source]) -> Iterator[Diagnostic]:
    """Yield a warning for each comment that may belong to its expression: only a number, or an operator and a word."""
    lines = {source.file: source.lines for source in sources}
    for node in _expressions(root.get("routes"), is_expression=False):
        span = node.span
        comment = lines[span.file][span.line - 1][span.end_column - 1 :] if node.text_span.is_whole_line else ""
        if _REST.fullmatch(comment):
            what = f"the comment '{comment.strip()}' is not part of the expression before it"
            hint = "replace '#' with an operator, or add words to the comment"
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
