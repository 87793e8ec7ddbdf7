"""JSON text from clients, who may send anything: read strictly, in time and memory that its length bounds.

Stricter than the standard: no key twice, no lone surrogate, no number beyond what a double holds. Knows no message
types.
"""

from __future__ import annotations

import json
import math
import re
from typing import NoReturn

from router.gateway.invalid import InvalidMessageError, shown

_MOST_DEEP = 64
"""Lists and objects within each other."""
_MOST_HOLDERS = 100_000
"""Lists and objects in one text. They take up to 40 times the memory of their characters, and the garbage collector
looks at all of them at once: 10 ms in which no other thread runs."""
_MOST_DIGITS = 25
"""Of an integer. The largest of 64 bits has 20."""
_SHORT = 1 << 16
"""Characters that the json module gets at once. It holds the interpreter lock for as long as it reads them."""
_PIECE = 1 << 13
"""Characters of a list of numbers that it gets at once: 4096 elements at most."""

_SPACE = re.compile(r"[ \t\n\r]*")
_DIGITS = bytes.maketrans(b"123456789E", b"000000000e")
_LONG_NUMBER, _LONG_EXPONENT = b"0" * (_MOST_DIGITS + 1), b"e000"
"""One of them is in each number that `_integer` or `_float` could refuse, and in few others, with all digits made 0."""
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")


def parse_json(text: bytes) -> object:
    """The value that UTF-8 `text` stands for: a dict, list, str, int, float, bool or None.

    Raises InvalidMessageError.
    """
    try:
        decoded = text.decode()
    except UnicodeDecodeError as error:
        raise InvalidMessageError(f"no UTF-8 at byte {error.start}") from None
    # So few brackets cannot be too deep, whatever they mean.
    is_plain = len(decoded) <= _SHORT and decoded.count("[") + decoded.count("{") <= _MOST_DEEP
    try:
        value = _STRICT.decode(decoded) if is_plain else _LongText(decoded).parsed()
    except json.JSONDecodeError as error:
        raise InvalidMessageError(f"no JSON: {error.msg} (character {error.pos})") from None
    if _SURROGATE.search(decoded):
        _refuse_lone_surrogates(value)
    return value


class _LongText:
    """The same for text that is long or has many brackets: their depth and number are counted, and nothing that
    comes out of one call of the json module is large.
    """

    def __init__(self, text: str) -> None:
        self._text = text
        self._holders = 0

    def parsed(self) -> object:
        value, at = self._value(self._after_space(0), 0)
        at = self._after_space(at)
        if at != len(self._text):
            self._refuse("Extra data", at)
        return value

    def _refuse(self, reason: str, at: int) -> NoReturn:
        raise json.JSONDecodeError(reason, self._text, at)

    def _after_space(self, at: int) -> int:
        found = _SPACE.match(self._text, at)
        return found.end() if found else at

    def _value(self, at: int, depth: int) -> tuple[object, int]:
        """The value that begins at `at`, and where it ends."""
        letter = self._text[at : at + 1]
        if letter not in {"[", "{"}:
            return _STRICT.raw_decode(self._text, at)
        self._holders += 1
        if depth == _MOST_DEEP or self._holders > _MOST_HOLDERS:
            reason = f"more than {_MOST_DEEP} deep" if depth == _MOST_DEEP else f"more than {_MOST_HOLDERS} lists"
            raise InvalidMessageError(f"{reason} (character {at})")
        return self._list(at + 1, depth + 1) if letter == "[" else self._object(at + 1, depth + 1)

    def _object(self, at: int, depth: int) -> tuple[object, int]:
        text, members = self._text, list[tuple[str, object]]()
        at = self._after_space(at)
        if text[at : at + 1] == "}":
            return {}, at + 1
        while True:
            if text[at : at + 1] != '"':
                self._refuse("Expecting property name enclosed in double quotes", at)
            name, at = _STRICT.raw_decode(text, at)
            at = self._after_space(at)
            if text[at : at + 1] != ":":
                self._refuse("Expecting ':' delimiter", at)
            value, at = self._value(self._after_space(at + 1), depth)
            members.append((name, value))
            at = self._after_space(at)
            if text[at : at + 1] == "}":
                return _members(members), at + 1
            at = self._after_comma(at)

    def _list(self, at: int, depth: int) -> tuple[object, int]:
        text, elements = self._text, list[object]()
        at = self._after_space(at)
        if text[at : at + 1] == "]":
            return elements, at + 1
        while True:
            if text[at : at + 1] not in {'"', "[", "{"} and (numbers := self._numbers(at)):
                several, at = numbers
                elements += several
            else:
                value, at = self._value(at, depth)
                elements.append(value)
                at = self._after_space(at)
            if text[at : at + 1] == "]":
                return elements, at + 1
            at = self._after_comma(at)

    def _after_comma(self, at: int) -> int:
        if self._text[at : at + 1] != ",":
            self._refuse("Expecting ',' delimiter", at)
        return self._after_space(at + 1)

    def _numbers(self, at: int) -> tuple[list[object], int] | None:
        """The elements from `at` on that are not strings, lists or objects, as many as are in one piece, and where
        they end. None where that is not to be seen so easily.
        """
        end = self._text.find("]", at, at + _PIECE)
        if end < 0:
            end = self._text.rfind(",", at, at + _PIECE)
        piece = self._text[at : max(end, at)]
        if not piece or '"' in piece or "[" in piece or "{" in piece:
            return None
        digits = piece.encode().translate(_DIGITS, b"+")
        is_harmless = _LONG_NUMBER not in digits and _LONG_EXPONENT not in digits
        try:
            values = (_HARMLESS if is_harmless else _STRICT).decode(f"[{piece}]")
        except json.JSONDecodeError as error:
            self._refuse(error.msg, at + error.pos - 1)
        return values, end


def _members(pairs: list[tuple[str, object]]) -> dict[str, object]:
    made = dict(pairs)
    if len(made) != len(pairs):
        for name, _ in pairs:
            if name not in made:
                raise InvalidMessageError(f"{shown(name)} is there twice")
            del made[name]
    return made


def _integer(text: str) -> int:
    if len(text) > _MOST_DIGITS + text.startswith("-"):
        raise InvalidMessageError(f"an integer has more than {_MOST_DIGITS} digits")
    return int(text)


def _float(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise InvalidMessageError(f"{shown(text)} is beyond what a double holds")
    return value


def _constant(text: str) -> NoReturn:
    raise InvalidMessageError(f"{text} is no JSON")


def _refuse_lone_surrogates(value: object) -> None:
    left = [value]
    while left:
        match left.pop():
            case str() as text:
                try:
                    text.encode()
                except UnicodeEncodeError:
                    raise InvalidMessageError("a string has half of a surrogate pair") from None
            case list() as elements:
                left += elements
            case dict() as members:
                left += members
                left += members.values()


_STRICT = json.JSONDecoder(object_pairs_hook=_members, parse_int=_integer, parse_float=_float, parse_constant=_constant)
_HARMLESS = json.JSONDecoder(parse_constant=_constant)
"""For lists of numbers none of which could be refused: without a call for each."""
