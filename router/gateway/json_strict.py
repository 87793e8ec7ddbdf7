"""What JSON text from clients may hold, and the decoders that see to it. They hold the interpreter lock as they work.

Stricter than the standard: no key twice, no lone surrogate, no number beyond what a double holds.
"""

from __future__ import annotations

import json
import math
import re
from typing import Any, NoReturn

from router.gateway.invalid import InvalidMessageError, shown

_MOST_DIGITS = 25
"""Of an integer. The largest of 64 bits has 20."""

_DIGITS = bytes.maketrans(b"123456789E", b"000000000e")
_LONG_NUMBER, _LONG_EXPONENT = b"0" * (_MOST_DIGITS + 1), b"e000"
"""One of them is in each number that `_integer` or `_float` could refuse, and in few others, with all digits made 0."""
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")


def for_list(piece: str) -> json.JSONDecoder:
    """For elements of a list: without a call for each number, if none of them could be refused."""
    digits = piece.encode().translate(_DIGITS, b"+")
    return _HARMLESS if _LONG_NUMBER not in digits and _LONG_EXPONENT not in digits else STRICT


def members(pairs: list[tuple[str, object]]) -> dict[str, object]:
    made = dict(pairs)
    if len(made) != len(pairs):
        for name, _ in pairs:
            if name not in made:
                raise InvalidMessageError(f"{shown(name)} is there twice")
            del made[name]
    return made


def check_surrogates(text: str, value: object) -> None:
    """Refuses half of a surrogate pair in `value`, which is what `text` stands for. Text has no other to begin with."""
    if not _SURROGATE.search(text):
        return
    left = [value]
    while left:
        match left.pop():
            case str() as found:
                try:
                    found.encode()
                except UnicodeEncodeError:
                    raise InvalidMessageError("a string has half of a surrogate pair") from None
            case list() | tuple() as elements:
                left += elements
            case dict() as inside:
                left += inside
                left += inside.values()


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


_KINDS: Any = {"parse_int": _integer, "parse_float": _float, "parse_constant": _constant}
STRICT = json.JSONDecoder(object_pairs_hook=members, **_KINDS)
PAIRS = json.JSONDecoder(object_pairs_hook=list, **_KINDS)
"""For members of an object: a list of names and values."""
_HARMLESS = json.JSONDecoder(parse_constant=_constant)
