"""JSON text that is long or has many brackets, read piece by piece: in time that is in proportion to its length, with
the interpreter lock held for short stretches only, and with what takes much memory counted. Knows no message types.
"""

from __future__ import annotations

import json
import re
from operator import countOf
from typing import Any, NoReturn

from router.gateway.invalid import InvalidMessageError
from router.gateway.json_strict import PAIRS, STRICT, check_surrogates, for_list, members

MOST_DEEP = 64
"""Lists and objects within each other."""
_MOST_HOLDERS = 100_000
"""Lists and objects in one text. They take up to 40 times the memory of their characters, and the garbage collector
looks at all of them at once: 10 ms in which no other thread runs."""
_MOST_TEXTS = 400_000
"""Texts and names in one text. They take up to 20 times the memory of their characters."""
_PIECE = 1 << 13
"""Characters that the json module gets at once: 4096 elements at most. It holds the interpreter lock meanwhile."""

_SPACE = re.compile(r"[ \t\n\r]*")
_STRETCH = re.compile(r'[^"\[\]{}]*(?:"[^"\\]*(?:\\.[^"\\]*)*"[^"\[\]{}]*)*(?=[,\]}])', re.DOTALL)
"""Elements or members, none of which is a list or an object, up to a comma or an end."""
_INSIDE = re.compile(r'[^"\\]*(?:\\(?:[^u]|u.{4})[^"\\]*)*', re.DOTALL)
"""Of a text."""
_NAME = re.compile(r'"([^"\\\x00-\x1f]*)"[ \t\n\r]*:[ \t\n\r]*(?=[^ \t\n\r])')
_LITTLE_LIST = re.compile(r'\[[^"\[\]{}]{0,40}\]')
_HIGH_SURROGATE = re.compile(r"\\u[dD][89abAB]..\Z")


class PiecewiseText:
    """`parsed` raises InvalidMessageError, or json.JSONDecodeError."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._holders = 0
        self._texts = 0

    def parsed(self) -> object:
        value, at = self._value(self._after_space(0), 0)
        at = self._after_space(at)
        if at != len(self._text):
            self._refuse("Extra data", at)
        return value

    def _refuse(self, reason: str, at: int) -> NoReturn:
        raise json.JSONDecodeError(reason, self._text, at)

    def _after_space(self, at: int) -> int:
        while (found := _SPACE.match(self._text, at, at + _PIECE)) and found.end() == at + _PIECE:
            at += _PIECE
        return found.end() if found else at

    def _after_comma(self, at: int) -> int:
        if self._text[at : at + 1] != ",":
            self._refuse("Expecting ',' delimiter", at)
        return self._after_space(at + 1)

    def _count_texts(self, count: int) -> None:
        self._texts += count
        if self._texts > _MOST_TEXTS:
            raise InvalidMessageError(f"more than {_MOST_TEXTS} texts and names")

    def _decoded(self, decoder: json.JSONDecoder, piece: str, at: int) -> Any:
        """What `piece` stands for: the text from `at` on, with one character in front of it and one behind."""
        try:
            value = decoder.decode(piece)
        except json.JSONDecodeError as error:
            self._refuse(error.msg, at + error.pos - 1)
        check_surrogates(piece, value)
        return value

    def _value(self, at: int, depth: int) -> tuple[object, int]:
        """The value that begins at `at`, and where it ends."""
        letter = self._text[at : at + 1]
        if letter == '"':
            return self._string(at)
        if letter not in {"[", "{"}:
            # Of a number that is longer, the rest is taken for what follows, and refused as that.
            return self._short(at, self._text[at : at + _PIECE])
        self._holders += 1
        if depth == MOST_DEEP or self._holders > _MOST_HOLDERS:
            reason = f"more than {MOST_DEEP} deep" if depth == MOST_DEEP else f"more than {_MOST_HOLDERS} lists"
            raise InvalidMessageError(f"{reason} (character {at})")
        if letter == "{":
            return self._object(at + 1, depth + 1)
        if found := _LITTLE_LIST.match(self._text, at):  # as most of wrapped messages are
            return self._short(at, found.group())
        return self._list(at + 1, depth + 1)

    def _short(self, at: int, piece: str) -> tuple[object, int]:
        """What `piece` begins with, which is the text from `at` on, and where that ends."""
        try:
            value, length = STRICT.raw_decode(piece)
        except json.JSONDecodeError as error:
            self._refuse(error.msg, at + error.pos)
        return value, at + length

    def _string(self, at: int) -> tuple[str, int]:
        self._count_texts(1)
        parts, start, text = list[str](), at, self._text
        at += 1
        while True:
            found = _INSIDE.match(text, at, at + _PIECE)
            end = found.end() if found else at
            if _HIGH_SURROGATE.search(text, max(at, end - 6), end) and text[end : end + 2] == "\\u":
                end += 6  # its other half, or it is no JSON
            closing = text[end : end + 1]
            if end == at and closing != '"':
                self._refuse("Unterminated string starting at", start)
            parts.append(self._decoded(STRICT, f'"{text[at:end]}"', at))
            if closing == '"':
                return "".join(parts), end + 1
            at = end

    def _stretch(self, at: int) -> str:
        """Elements or members from `at` on that can be read at once."""
        found = _STRETCH.match(self._text, at, at + _PIECE)
        return found.group() if found else ""

    def _object(self, at: int, depth: int) -> tuple[object, int]:
        text, pairs = self._text, list[tuple[str, object]]()
        at = self._after_space(at)
        if text[at : at + 1] == "}":
            return {}, at + 1
        while True:
            if piece := self._stretch(at):
                several = self._decoded(PAIRS, f"{{{piece}}}", at)
                self._count_texts(len(several))
                pairs += several
                at += len(piece)
            else:
                pair, at = self._member(at, depth)
                pairs.append(pair)
                at = self._after_space(at)
            if text[at : at + 1] == "}":
                return members(pairs), at + 1
            at = self._after_comma(at)

    def _member(self, at: int, depth: int) -> tuple[tuple[str, object], int]:
        if found := _NAME.match(self._text, at, at + _PIECE):
            self._count_texts(1)
            name, at = found[1], found.end()
        else:
            name, at = self._unusual_name(at)
        value, at = self._value(at, depth)
        return (name, value), at

    def _unusual_name(self, at: int) -> tuple[str, int]:
        """And where its value begins."""
        if self._text[at : at + 1] != '"':
            self._refuse("Expecting property name enclosed in double quotes", at)
        name, at = self._string(at)
        at = self._after_space(at)
        if self._text[at : at + 1] != ":":
            self._refuse("Expecting ':' delimiter", at)
        return name, self._after_space(at + 1)

    def _list(self, at: int, depth: int) -> tuple[object, int]:
        elements = list[object]()
        try:
            return elements, self._fill(elements, at, depth)
        except (InvalidMessageError, json.JSONDecodeError):
            let_go(elements)
            raise

    def _fill(self, elements: list[object], at: int, depth: int) -> int:
        text = self._text
        at = self._after_space(at)
        if text[at : at + 1] == "]":
            return at + 1
        while True:
            if piece := self._stretch(at):
                several = self._decoded(for_list(piece), f"[{piece}]", at)
                if '"' in piece:
                    self._count_texts(countOf(map(type, several), str))
                elements += several
                at += len(piece)
            else:
                value, at = self._value(at, depth)
                elements.append(value)
                at = self._after_space(at)
            if text[at : at + 1] == "]":
                return at + 1
            at = self._after_comma(at)


def let_go(value: object) -> None:
    """Empties what `parsed` has returned, bit by bit: millions of numbers freed at once would hold up other threads."""
    left = [value]
    while left:
        match left.pop():
            case dict() as inside:
                left += inside.values()
            case list() as elements:
                while elements:
                    last = elements[-_PIECE:]
                    del elements[-_PIECE:]
                    if not {list, dict}.isdisjoint(map(type, last)):
                        left += [each for each in last if type(each) is list or type(each) is dict]
