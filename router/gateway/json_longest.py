"""How long the JSON text of a message can be, by its type. Knows no messages."""

from __future__ import annotations

from math import inf

from router.gateway.style import PLACEHOLDER, Style
from router.types.model import Bool, Field, Float, Int, List, MessageType, String, Type

_AROUND = 256
"""Characters of brackets, commas and white space before and behind a value: more than pretty printing takes."""
_NUMBER = 400
"""Of a double in full: 309 digits before the point, and some behind."""
_INTEGER = 32
_ESCAPED = 6
"""Of one character, as in `\\u0041`; a byte of UTF-8 may be one."""
_PLACEHOLDERS = (Field(PLACEHOLDER, Int(8, signed=False)),)


def longest_text(declared: Type, style: Style) -> float:
    """Characters that any sensible JSON text of a value has at most; infinite where the type sets no bound."""
    match declared:
        case Bool() | Int():
            return _AROUND + _INTEGER
        case Float():
            return _AROUND + _NUMBER
        case String():
            unit = _AROUND + _INTEGER if declared.wide and style is Style.WRAPPED else _ESCAPED
            return _AROUND + (inf if declared.bound is None else declared.bound * unit)
        case List():
            count = declared.bound if declared.length is None else declared.length
            return _AROUND + (inf if count is None else count * longest_text(declared.element, style) if count else 0)
        case MessageType():
            fields = declared.fields or _PLACEHOLDERS
            return _AROUND + sum(_longest_member(field, style) for field in fields)
        case _:
            raise TypeError(f"ROS has no type {declared}")


def _longest_member(field: Field, style: Style) -> float:
    list_of_one = _AROUND if style is Style.WRAPPED else 0
    return _AROUND + _ESCAPED * len(field.name) + list_of_one + longest_text(field.type, style)
