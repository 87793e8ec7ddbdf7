"""JSON text from clients, who may send anything: read strictly, in time and memory that its length bounds.

`json_strict` has what is refused, `json_pieces` how long text is read. Knows no message types.
"""

from __future__ import annotations

import json
import re

from router.gateway.invalid import InvalidMessageError
from router.gateway.json_pieces import MOST_DEEP, PiecewiseText
from router.gateway.json_strict import STRICT, check_surrogates

_SHORT = 1 << 16
"""Characters that the json module gets at once. It holds the interpreter lock for as long as it reads them."""

_STRING = re.compile(r'"[^"\\]*(?:\\.[^"\\]*)*"', re.DOTALL)
_BRACKETS = bytes.maketrans(b"{}", b"[]")
_OTHERS = bytes({*range(256)} - {*b"[]{}"})


def parse_json(text: bytes) -> object:
    """The value that UTF-8 `text` stands for: a dict, list, str, int, float, bool or None.

    Raises InvalidMessageError.
    """
    try:
        decoded = text.decode()
    except UnicodeDecodeError as error:
        raise InvalidMessageError(f"no UTF-8 at byte {error.start}") from None
    try:
        if len(decoded) > _SHORT or not _is_flat(decoded):
            return PiecewiseText(decoded).parsed()
        value: object = STRICT.decode(decoded)
    except json.JSONDecodeError as error:
        raise InvalidMessageError(f"no JSON: {error.msg} (character {error.pos})") from None
    check_surrogates(decoded, value)
    return value


def _is_flat(text: str) -> bool:
    """Whether no list or object in it can be too deep, if it is JSON."""
    if text.count("[") + text.count("{") <= MOST_DEEP:
        return True
    brackets = _STRING.sub("", text).encode().translate(_BRACKETS, _OTHERS)
    for _ in range(MOST_DEEP):
        brackets = brackets.replace(b"[]", b"")
        if not brackets:
            return True
    return False
