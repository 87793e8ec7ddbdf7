"""The text of one `.proto` file, and places in it as protoc counts them turned into source spans.

Knows nothing of what the text means.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

from router.errors import SourceSpan, shown_path

_TAB_WIDTH = 8
_MERGE_MARK = re.compile(rb"(?:(<{7}|>{7})|={7})(?=\s|$)")
_WORD = re.compile(rb'"[^"\n]*"?|[\w.]+|.')


class ProtoText:
    """Read only when somebody asks for a place. protoc counts lines and columns from 0."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    def _lines(self) -> list[bytes]:
        return self.path.read_bytes().split(b"\n")

    def span(self, location: Sequence[int]) -> SourceSpan:
        """A location of protoc's source info: line, column, end column, or with the end's line as third."""
        if len(location) == 3:
            return self._between(location[0], location[1], location[2])
        line = self._line(location[0])
        return self._between(location[0], location[1], _width(line.rstrip()))

    def word(self, line: int, column: int) -> SourceSpan:
        """The name, number or sign that begins at the place."""
        text = self._line(line)
        start = _offset(text, column)
        word = _WORD.match(text, start)
        return self._span(line, start, word.end() if word else start)

    def nearest(self, pattern: str, line: int) -> SourceSpan | None:
        """The match of a regular expression that is nearest to the line."""
        matches = [
            (number, match) for number, text in enumerate(self._lines) for match in re.finditer(pattern.encode(), text)
        ]
        if not matches:
            return None
        number, match = min(matches, key=lambda found: abs(found[0] - line))
        return self._span(number, match.start(), match.end())

    def merge_mark(self, line: int) -> SourceSpan | None:
        """The first mark that an unresolved merge left in the file, with `=======` only on this line."""
        for number, text in enumerate(self._lines):
            if (found := _MERGE_MARK.match(text)) and (found[1] or number == line):
                return self._span(number, 0, found.end())
        return None

    def before(self, line: int, column: int) -> str:
        """What stands before the place on its line, without blanks at its end."""
        text = self._line(line)
        return text[: _offset(text, column)].decode(errors="replace").rstrip()

    def _line(self, line: int) -> bytes:
        return self._lines[line] if line < len(self._lines) else b""

    def _between(self, line: int, start: int, end: int) -> SourceSpan:
        text = self._line(line)
        return self._span(line, _offset(text, start), _offset(text, end))

    def _span(self, line: int, start: int, end: int) -> SourceSpan:
        """From byte offsets, which are not columns where the text is not ASCII."""
        text = self._line(line)
        first = len(text[:start].decode(errors="replace")) + 1
        return SourceSpan(shown_path(self.path), line + 1, first, first + len(text[start:end].decode(errors="replace")))


def _offset(text: bytes, column: int) -> int:
    """The byte at protoc's column: it counts bytes, but a tab goes on to the next multiple of eight."""
    at = 0
    for offset, byte in enumerate(text):
        if at >= column:
            return offset
        at = at - at % _TAB_WIDTH + _TAB_WIDTH if byte == 0x09 else at + 1
    return len(text)


def _width(text: bytes) -> int:
    return len(text.expandtabs(_TAB_WIDTH))
