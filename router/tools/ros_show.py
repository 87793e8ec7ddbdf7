"""A ROS message object as one line of `field=value` words, and as what JSON can hold.

Needs no definition: rclpy's classes tell their fields. Knows no node.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from router.tools.show import float_text

SHOWN_ELEMENTS = 8
"""Of an array; a picture has a million."""


def ros_words(message: Any) -> Iterator[str]:
    """`path=value` of every field that is not zero or empty; of arrays the first elements."""
    for name, spelled in message.get_fields_and_field_types().items():
        yield from _words(getattr(message, name), spelled, name)


def ros_json(value: Any) -> Any:
    """A message as dict, an array as list; numbers that JSON lacks as protobuf's mapping spells them."""
    if _is_message(value):
        return {name: ros_json(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if _is_array(value):
        return [ros_json(element) for element in _python(value)]
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return value[0] if isinstance(value, bytes) else value


def _words(value: Any, spelled: str, path: str) -> Iterator[str]:
    """`spelled` is the field's type in rclpy's words: `float`, `sequence<double, 5>`, `uint8[4]`."""
    if _is_message(value):
        for name, inner in value.get_fields_and_field_types().items():
            yield from _words(getattr(value, name), inner, f"{path}.{name}")
    elif not _is_array(value):
        if value not in _NOTHING:
            yield f"{path}={_text(value, spelled)}"
    elif any(value):
        first = _python(value[:SHOWN_ELEMENTS])
        is_cut = len(value) > len(first)
        if not _is_message(first[0]):
            shown = [_text(element, spelled) for element in first] + ["..."] * is_cut
            yield f"{path}=[{','.join(shown)}]" + (f"({len(value)})" if is_cut else "")
            return
        for index, element in enumerate(first):
            yield from _words(element, spelled, f"{path}[{index}]")
        if is_cut:
            yield f"{path}=...({len(value)})"


_NOTHING = (0, "", b"\0")


def _text(value: Any, spelled: str) -> str:
    if isinstance(value, float):
        return float_text(value, 64 if "double" in spelled else 32)
    if isinstance(value, bytes):  # an octet
        return str(value[0])
    return str(value).lower() if isinstance(value, bool) else str(value)


def _is_message(value: Any) -> bool:
    return hasattr(value, "get_fields_and_field_types")


def _is_array(value: Any) -> bool:
    """A list, an array.array or a numpy array."""
    return hasattr(value, "__len__") and not isinstance(value, (str, bytes))


def _python(array: Any) -> list[Any]:
    """The elements as Python's own numbers."""
    return array.tolist() if hasattr(array, "tolist") else list(array)
