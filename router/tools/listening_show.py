"""How a person and a program see what was heard: a line with the values, or a JSON object as received.

Knows no terminal; a line comes as pieces of text, each with a style.
"""

from __future__ import annotations

import datetime as dt
import json
from collections.abc import Iterable, Mapping
from typing import Any

from router.tools.listening_reading import Heard, Message, Problem, Remark, Schema, Shape
from router.values import SHOWN_ELEMENTS, Tree, list_text, one_line, plain_text, words

Piece = tuple[str, str]
"""Text, and a style of rich."""

_LONGEST_TEXT = 120
"""Characters of a string."""

_MOST_BYTES = 60
"""Of what is no packet."""

_NO_SHAPE: Mapping[str, Shape] = {}


def json_line(heard: Heard) -> str:
    """One JSON object, of what was received as it was received."""
    return json.dumps(_as_json(heard), separators=(",", ":"))


def _as_json(heard: Heard) -> Mapping[str, object]:
    if isinstance(heard, Remark):
        return heard.document
    if isinstance(heard, Problem):
        return {"problem": heard.reason, "bytes": len(heard.data), "hex": heard.data.hex()}
    if isinstance(heard, Message):
        return {"time": heard.time, "topic": heard.topic, "type": heard.type_name, "data": heard.data}
    topic = {"topic": heard.topic} if heard.topic else {}
    return {"time": heard.time, **topic, "type": heard.type_name, "schema": heard.schema}


def pieces(heard: Heard) -> list[Piece]:
    """`12:00:00.123 /imu/data sensor_msgs/msg/Imu x=0.01`."""
    if isinstance(heard, Message):
        values = _line(words(_tree(heard.data, heard.shape or _NO_SHAPE, heard.is_wrapped)))
        return [(_clock(heard.time), "dim"), _name(heard.topic, "green"), _name(heard.type_name, "dim"), (values, "")]
    if isinstance(heard, Schema):
        fields = _line(f"{name}:{_type_text(shape)}" for name, shape in heard.shape.items())
        where = [_name(heard.topic, "green")] if heard.topic else []
        return [(_clock(heard.time), "dim"), *where, _name(heard.type_name, "dim"), (f"schema {fields}", "cyan")]
    if isinstance(heard, Problem):
        return [("undecodable", "red"), (f"({heard.reason}):", ""), (_bytes_text(heard.data), "")]
    return [(_line(_remark(heard.document)), "yellow" if heard.document["op"] == "rejected" else "dim")]


def _remark(document: Mapping[str, Any]) -> Iterable[str]:
    """Of topics their names."""
    if not isinstance(rows := document.get("topics"), list):
        return words(_tree(document, _NO_SHAPE, is_wrapped=False))
    names = (str(row["topic"]) for row in rows if isinstance(row, dict) and "topic" in row)
    return [document["op"], f"{len(rows)}:", *names]


def _clock(seconds: float) -> str:
    """Local time of day; a sender's clock may say anything."""
    try:
        return f"{dt.datetime.fromtimestamp(seconds).astimezone():%H:%M:%S.%f}"[:-3]
    except (OverflowError, OSError, ValueError):
        return f"time={seconds}"


def _bytes_text(data: bytes) -> str:
    rest = f"...({len(data)} bytes)" if len(data) > _MOST_BYTES else ""
    return data[:_MOST_BYTES].hex() + rest or "no bytes"


def _name(text: str, style: str) -> Piece:
    return one_line([text]), style


def _line(listed: Iterable[str]) -> str:
    return one_line(listed, empty="(empty)")


def _type_text(shape: Shape) -> str:
    return shape.type_name + "[]" * shape.is_array


def _tree(values: Mapping[str, Any], shapes: Mapping[str, Shape], is_wrapped: bool) -> Mapping[str, Tree]:
    """A single value is taken out of its list."""
    tree: dict[str, Tree] = {}
    for name, value in values.items():
        shape = shapes.get(name)
        if is_wrapped and shape is not None and not shape.is_array and isinstance(value, list) and len(value) == 1:
            [value] = value  # noqa: PLW2901
        if isinstance(value, list) and any(isinstance(element, dict) for element in value):
            for index, element in enumerate(value[:SHOWN_ELEMENTS]):
                tree[f"{name}[{index}]"] = _value(element, shape, is_wrapped)
            if len(value) > SHOWN_ELEMENTS:
                tree[name] = f"...({len(value)})"
        else:
            tree[name] = _value(value, shape, is_wrapped)
    return tree


def _value(value: Any, shape: Shape | None, is_wrapped: bool) -> Tree:
    if isinstance(value, dict):
        return _tree(value, shape.members if shape is not None else _NO_SHAPE, is_wrapped)
    if isinstance(value, list):
        return list_text((_text(element, shape) for element in value[:SHOWN_ELEMENTS]), len(value), SHOWN_ELEMENTS)
    return _text(value, shape)


def _text(value: Any, shape: Shape | None) -> str:
    if isinstance(value, str):
        return _cut(value)
    return plain_text(value, 32 if shape is not None and shape.type_name == "float32" else 64)


def _cut(text: str) -> str:
    return text if len(text) <= _LONGEST_TEXT else f"{text[:_LONGEST_TEXT]}...({len(text)})"
