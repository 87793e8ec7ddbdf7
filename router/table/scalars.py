"""What a plain YAML scalar means: the core schema of YAML 1.2, and where YAML 1.1 would read it differently.

Knows text only, no positions and no keys.
"""

from __future__ import annotations

import math
import re
from typing import NamedTuple

from router.table.nodes import Plain

_WORDS: dict[str, Plain] = {
    **dict.fromkeys(("", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
}
_INT = re.compile(r"[-+]?[0-9]{1,300}")  # Python refuses to read far longer ones
_HEX = re.compile(r"0x[0-9a-fA-F]{1,300}")
_FLOAT = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")


class Surprise(NamedTuple):
    """What some YAML readers take a scalar for, and how to say what one means."""

    meaning: str
    remedy: str


_TRUTH = frozenset(spelling for word in ("yes", "no", "on", "off") for spelling in (word, word.title(), word.upper()))
_OCTAL = Surprise("an octal number", "write a decimal number without leading zeros")
_BINARY = Surprise("a binary number", "write a decimal number")
_HEXADECIMAL = Surprise("a hexadecimal number", "write a decimal number")
_GROUPED = Surprise("a number", "leave out the '_'")
_SURPRISES = (
    (re.compile("|".join(_TRUTH)), Surprise("a truth value", "write true or false")),
    (re.compile("~"), Surprise("an empty value", "write null")),
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


def resolve(text: str) -> Plain:
    """The value of a plain scalar. Infinities and NaN have no place in a table: `.inf` and `1e999` stay text."""
    if text in _WORDS:
        return _WORDS[text]
    if _INT.fullmatch(text):
        return int(text)
    if _HEX.fullmatch(text):
        return int(text, 16)
    if _FLOAT.fullmatch(text) and math.isfinite(number := float(text)):
        return number
    return text


def surprise(text: str) -> Surprise | None:
    """Why the plain scalar means different things to readers of YAML 1.1 and 1.2; None where it does not."""
    return next((found for pattern, found in _SURPRISES if pattern.fullmatch(text)), None)
