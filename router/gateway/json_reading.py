"""What clients send: a message's JSON, parsed, to CDR bytes, with every field checked against the message's type.

The opposite of `json_code`. Knows neither packets nor documents; `json_parsing` has the text, `cdr_writing` the bytes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from router.compiler.cdr.primitives import HEADER
from router.gateway.cdr_writing import Numbers, Put, put_size, text_writer
from router.gateway.invalid import InvalidMessageError, shown
from router.gateway.json_parsing import parse_json
from router.gateway.style import PLACEHOLDER, Style
from router.types.model import Bool, Field, Float, Int, List, MessageType, String, Type

__all__ = ["InvalidMessageError", "cdr_builder", "example", "parse_json"]

_PLACEHOLDER = Field(PLACEHOLDER, Int(8, signed=False))


def cdr_builder(message: MessageType, style: Style) -> Callable[[object], bytes]:
    """A function that makes the CDR bytes, with their header, of a message that `parse_json` has read.

    Every field must be there and no other, each of its type and within its range: 3.0 is no integer, and true no
    number. The function raises InvalidMessageError, its text naming the field.
    """
    put = _message_writer(message, style)

    def build(value: object) -> bytes:
        data = bytearray()
        put(data, value)
        return HEADER + data

    return build


def _writer(declared: Type, style: Style) -> Put:
    """For a field, which a wrapped message has in a list of its own."""
    if isinstance(declared, List):
        return _list_writer(declared, style)
    put = _bare_writer(declared, style)
    return put if style is Style.PLAIN else _unwrapping(put)


def _bare_writer(declared: Type, style: Style) -> Put:
    match declared:
        case MessageType():
            return _message_writer(declared, style)
        case String():
            return text_writer(declared, of_units=style is Style.WRAPPED)
        case Bool() | Int() | Float():
            return Numbers(declared).put
        case _:
            raise TypeError(f"ROS has no type {declared}")


def _unwrapping(put: Put) -> Put:
    def put_only(data: bytearray, value: Any) -> None:
        if type(value) is not list or len(value) != 1:
            count = f"{len(value)} elements" if type(value) is list else shown(value)
            raise InvalidMessageError(f"{count} instead of a list of one")
        put(data, value[0])

    return put_only


def _message_writer(message: MessageType, style: Style) -> Put:
    if not message.fields:
        return _nothing_writer(message.name, style)
    names = frozenset(field.name for field in message.fields)
    members = tuple((field.name, _writer(field.type, style)) for field in message.fields)

    def put_message(data: bytearray, value: Any) -> None:
        if type(value) is not dict:
            raise InvalidMessageError(f"{shown(value)} is no {message.name}")
        if value.keys() != names:
            raise _other_fields(message, value)
        for name, put in members:
            try:
                put(data, value[name])
            except InvalidMessageError as error:
                raise error.inside(name) from None

    return put_message


def _nothing_writer(name: str, style: Style) -> Put:
    """For a message without fields, which may be given the one that rosidl adds: the existing gateway sends it."""
    put_field = _message_writer(MessageType(name, (_PLACEHOLDER,)), style)

    def put_nothing(data: bytearray, value: Any) -> None:
        if value == {}:
            data += b"\0"
        else:
            put_field(data, value)

    return put_nothing


def _other_fields(message: MessageType, value: dict[str, Any]) -> InvalidMessageError:
    for name in value:
        if message.field(name) is None:
            return InvalidMessageError(f"{shown(name)} is no field of {message.name}")
    return InvalidMessageError("is missing", next(field.name for field in message.fields if field.name not in value))


def _list_writer(declared: List, style: Style) -> Put:
    put_all = _elements_writer(declared.element, style)

    def put_list(data: bytearray, value: Any) -> None:
        put_size(data, declared, value)
        put_all(data, value)

    return put_list


def _elements_writer(element: Type, style: Style) -> Put:
    if isinstance(element, (Bool, Int, Float)):
        return Numbers(element).put_all
    put = _bare_writer(element, style)

    def put_all(data: bytearray, values: Any) -> None:
        for index, value in enumerate(values):
            try:
                put(data, value)
            except InvalidMessageError as error:
                raise error.inside(f"[{index}]") from None

    return put_all


def example(message: MessageType) -> dict[str, object]:
    """A message in plain style with all fields at their declared defaults, which `cdr_builder` takes."""
    return {field.name: _default(field.type, field.default) for field in message.fields}


def _default(declared: Type, default: Any) -> object:
    match declared:
        case MessageType():
            return example(declared)
        case List():
            values = [None] * (declared.length or 0) if default is None else default
            return [_default(declared.element, value) for value in values]
        case Bool():
            return bool(default)
        case String():
            return default or ""
        case Float():
            return default if default is not None and math.isfinite(default) else 0.0  # JSON has no infinity
        case _:
            return default or 0
