"""Constants and default values of a `.msg` file: text in, a Python value of the declared type out.

Quotes, escapes and ranges follow rosidl_adapter, the parser that ROS builds its interfaces with.
"""

from __future__ import annotations

import math
import re

from router.types.model import Bool, Float, Int, List, String, Type

_TRUTH = {"true": True, "1": True, "false": False, "0": False}
_ELEMENT = re.compile(r"""\s*("(?:[^"\\]|\\.)*"|'(?:[^'\\]|\\.)*'|[^,]*)\s*(,|$)""")


def parse_value(type_: Type, text: str) -> object:
    """The value that `text` stands for; a list's as a tuple. Raises ValueError, its text being the finding."""
    if isinstance(type_, List):
        return _parse_list(type_, text)
    if isinstance(type_, Bool):
        if text.lower() not in _TRUTH:
            raise ValueError(f"'{text}' is neither true nor false")
        return _TRUTH[text.lower()]
    if isinstance(type_, Int):
        return _parse_integer(type_, text)
    if isinstance(type_, Float):
        try:
            return float(text)
        except ValueError:
            raise ValueError(f"'{text}' is no number") from None
    if isinstance(type_, String):
        return _parse_string(type_, text)
    raise ValueError(f"a field of type {type_} takes no default value")


def is_zero(value: object) -> bool:
    """Whether a value is what its type holds when nothing is said."""
    if isinstance(value, tuple):
        return all(map(is_zero, value))
    if isinstance(value, float):
        return value == 0 and math.copysign(1, value) > 0
    return not value


def _parse_integer(type_: Int, text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        try:
            value = int(text, 0)
        except ValueError:
            raise ValueError(f"'{text}' is no integer") from None
    if not type_.low <= value <= type_.high:
        raise ValueError(f"{text} is outside of {type_}, {type_.low} to {type_.high}")
    return value


def _parse_string(type_: String, text: str) -> str:
    for quote in "\"'":
        if len(text) > 1 and text.startswith(quote) and text.endswith(quote):
            text = text[1:-1]
            if re.search(rf"(?<!\\){quote}", text):
                raise ValueError(f"a quote inside the string needs a backslash: {text}")
            text = text.replace(f"\\{quote}", quote)
            break
    if type_.bound is not None and len(text) > type_.bound:
        raise ValueError(f"'{text}' is longer than {type_.bound}")
    return text


def _parse_list(type_: List, text: str) -> tuple[object, ...]:
    if not (len(text) > 1 and text.startswith("[") and text.endswith("]")):
        raise ValueError(f"'{text}' is no list; write [1, 2]")
    inner = text[1:-1].strip()
    items = []
    at = 0
    while at < len(inner):
        element = _ELEMENT.match(inner, at)
        if element is None or not element[1]:
            raise ValueError(f"'{text}' is no list of {type_.element}")
        item = parse_value(type_.element, element[1].rstrip())
        items.append(item.strip() if isinstance(item, str) else item)  # even inside quotes, as rosidl_adapter does
        at = element.end()
    if type_.length is not None and len(items) != type_.length:
        raise ValueError(f"the array has {type_.length} elements, its default {len(items)}")
    if type_.bound is not None and len(items) > type_.bound:
        raise ValueError(f"the list has at most {type_.bound} elements, its default {len(items)}")
    return tuple(items)
