"""Where the characters of a YAML scalar stand in its file, also when it goes over several lines.

Knows neither YAML's rules nor what the text means: it compares what was written with what came of it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from router.errors import SourceSpan


@dataclass(frozen=True, slots=True)
class TextPlace:
    """`stretches` are the parts of the text that one line of the file has word for word: each with the
    offset into the text at which it begins. There are none where the text was made of something else
    (escapes, a value from a variable); then findings blame the whole.
    """

    whole: SourceSpan
    stretches: tuple[tuple[int, SourceSpan], ...] = ()

    def part(self, start: int, end: int) -> SourceSpan:
        """The span of characters `start` to `end` of the text (from 0, `end` exclusive), as far as its line goes."""
        for offset, span in reversed(self.stretches):
            if offset <= start:
                return span.part(start - offset, min(end - offset, span.end_column - span.column))
        return self.whole

    @property
    def is_whole_line(self) -> bool:
        """The text stands in the file as it is, on one line and without quotes."""
        return [span for _, span in self.stretches] == [self.whole]


def locate(text: str, whole: SourceSpan, pieces: Iterable[tuple[int, int, str]]) -> TextPlace:
    """The place of a text that was written in `pieces`, one for each line: line and column from 1, and what is there.

    Blanks at the ends of a piece, and what the text has in place of a line end, do not count.
    """
    stretches: list[tuple[int, SourceSpan]] = []
    offset = _after_blanks(text, 0)
    for line, column, piece in pieces:
        words = piece.strip()
        if not text.startswith(words, offset):
            return TextPlace(whole)
        if words:
            start = column + piece.index(words)
            stretches.append((offset, SourceSpan(whole.file, line, start, start + len(words))))
        offset = _after_blanks(text, offset + len(words))
    return TextPlace(whole, tuple(stretches) if offset == len(text) else ())


def _after_blanks(text: str, offset: int) -> int:
    while offset < len(text) and text[offset].isspace():
        offset += 1
    return offset
