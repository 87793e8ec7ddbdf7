"""Messages as a client's JSON library would write them, from plain values, without any code of the gateway."""

from __future__ import annotations

import json
import math
from typing import Any

from hypothesis import strategies as st

from router.types.model import Float, List, MessageType, String, Type
from tests.compiler.generated_types import values as any_values
from tests.compiler.reading import field_values

FORMS: list[dict[str, Any]] = [
    {},
    {"separators": (",", ":")},
    {"ensure_ascii": False},
    {"indent": 1},
    {"sort_keys": True, "separators": (" ,\r\n", "\t: ")},
]


def tree(declared: Type, value: Any, *, is_wrapped: bool) -> Any:
    """The JSON tree of a value, in the existing gateway's style or the plain style."""
    match declared:
        case MessageType():
            return {field.name: _member(field.type, value[field.name], is_wrapped) for field in declared.fields}
        case String(wide=True) if is_wrapped:
            units = value.encode("utf-16-le")
            return [units[at] + 256 * units[at + 1] for at in range(0, len(units), 2)]
        case _:
            return value


def _member(declared: Type, value: Any, is_wrapped: bool) -> Any:
    if isinstance(declared, List):
        return [tree(declared.element, element, is_wrapped=is_wrapped) for element in value]
    bare = tree(declared, value, is_wrapped=is_wrapped)
    return [bare] if is_wrapped else bare


def written(value: Any, form: dict[str, Any]) -> bytes:
    return json.dumps(value, **form).encode()


def values(declared: MessageType) -> st.SearchStrategy[dict[str, Any]]:
    """Values that both JSON and ROS can express: no NaN, no infinity, no NUL in strings."""
    return any_values(declared).map(lambda value: _common(declared, field_values(value, declared)))


def _common(declared: Type, value: Any) -> Any:
    match declared:
        case MessageType():
            return {field.name: _common(field.type, value[field.name]) for field in declared.fields}
        case List():
            return [_common(declared.element, element) for element in value[: declared.bound]]
        case String():
            text = value.replace("\0", "")
            while declared.bound is not None and _size(text, declared.wide) > declared.bound:
                text = text[:-1]
            return text
        case Float():
            return value if math.isfinite(value) else 1.5
        case _:
            return value


def _size(text: str, wide: bool) -> int:
    """The size that a bound limits: UTF-16 code units of a wstring, bytes of a string."""
    return len(text.encode("utf-16-le")) // 2 if wide else len(text.encode())
