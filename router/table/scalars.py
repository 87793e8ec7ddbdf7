"""What a plain YAML scalar means: the core schema of YAML 1.2, and where YAML 1.1 would read it differently.

Knows text only, no positions and no keys.
"""

from __future__ import annotations

import re

from router.table.nodes import Plain

_WORDS: dict[str, Plain] = {
    **dict.fromkeys(("", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
}
_INT = re.compile(r"[-+]?[0-9]{1,300}")  # Python refuses to read far longer ones
_HEX = re.compile(r"0x[0-9a-fA-F]{1,300}")
_FLOAT = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")

_TRUTH = frozenset(spelling for word in ("yes", "no", "on", "off") for spelling in (word, word.title(), word.upper()))
_SURPRISES = (
    (re.compile(r"[-+]?0[0-9_]+"), "an octal number"),
    (re.compile(r"0o[0-7]+"), "an octal number"),
    (re.compile(r"[-+]?0b[01_]+"), "a binary number"),
    (re.compile(r"[-+]0x[0-9a-fA-F_]+|0x_*[0-9a-fA-F]+_[0-9a-fA-F_]*|0x_[0-9a-fA-F_]+"), "a hexadecimal number"),
    (re.compile(r"[-+]?[0-9][0-9_]*(?::[0-5]?[0-9])+(?:\.[0-9_]*)?"), "a number in base 60"),
    (re.compile(r"[0-9]{4}-[0-9]{1,2}-[0-9]{1,2}(?:(?:[Tt]|[ \t]+)[0-9]{1,2}:[0-9:.]+[ \t]*[-+:0-9Z]*)?"), "a date"),
    (re.compile(r"(?=.*_)[-+]?(?:[0-9][0-9_]*(?:\.[0-9_]*)?|\.[0-9][0-9_]*)(?:[eE][-+]?[0-9]+)?"), "a number"),
)


def resolve(text: str) -> Plain:
    """The value of a plain scalar. Infinities and NaN have no place in a table: `.inf` stays text."""
    if text in _WORDS:
        return _WORDS[text]
    if _INT.fullmatch(text):
        return int(text)
    if _HEX.fullmatch(text):
        return int(text, 16)
    if _FLOAT.fullmatch(text):
        return float(text)
    return text


def surprise(text: str) -> str | None:
    """What some YAML readers take the plain scalar for while others take it for something else; else None."""
    if text in _TRUTH:
        return "a truth value"
    if text == "~":
        return "nothing"
    return next((meaning for pattern, meaning in _SURPRISES if pattern.fullmatch(text)), None)
