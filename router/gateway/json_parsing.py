"""JSON text from clients, who may send anything: read strictly, in time and memory that its length bounds.

`json_strict` has what is refused, `json_pieces` how long text is read. Knows no message types.
"""

from __future__ import annotations

import json

from router.gateway.invalid import InvalidMessageError
from router.gateway.json_pieces import MOST_DEEP, PiecewiseText
from router.gateway.json_strict import STRICT, check_surrogates

_SHORT = 1 << 16
"""Characters that the json module gets at once. It holds the interpreter lock for as long as it reads them."""


def parse_json(text: bytes) -> object:
    """The value that UTF-8 `text` stands for: a dict, list, str, int, float, bool or None.

    Raises InvalidMessageError.
    """
    try:
        decoded = text.decode()
    except UnicodeDecodeError as error:
        raise InvalidMessageError(f"no UTF-8 at byte {error.start}") from None
    # So few brackets cannot be too deep, whatever they mean.
    is_plain = len(decoded) <= _SHORT and decoded.count("[") + decoded.count("{") <= MOST_DEEP
    try:
        if not is_plain:
            return PiecewiseText(decoded).parsed()
        value: object = STRICT.decode(decoded)
    except json.JSONDecodeError as error:
        raise InvalidMessageError(f"no JSON: {error.msg} (character {error.pos})") from None
    check_surrogates(decoded, value)
    return value
