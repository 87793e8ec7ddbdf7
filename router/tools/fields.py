"""`field=value` words from a command line into a protobuf message, checked against its type.

Knows the type model and nothing of envelopes or sockets; `show` writes the same words back.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Sequence
from typing import Any

from google.protobuf.message import Message

from router.errors import UsageError, did_you_mean
from router.types.model import Bool, Bytes, Enum, Field, Float, Int, List, MessageType, String, Type

LARGEST_LIST = 65_507
"""No list is longer than the largest datagram has bytes."""

ENUM_RANGE = Int(32, signed=True)

_TRUTH = {"true": True, "1": True, "yes": True, "on": True, "false": False, "0": False, "no": False, "off": False}
_STEP = re.compile(r"(?P<name>\w+)(?:\[(?P<index>\d+)\])?")


def set_fields(message: Message, kind: MessageType, assignments: Sequence[str]) -> None:
    """Apply `path=value` words in order. A path is `x`, `bbox.x`, `points[1]` or `boxes[0].x`.

    A list without an index is appended to; `bbox=` alone makes an empty message present. Raises UsageError.
    """
    for assignment in assignments:
        path, equals, text = assignment.partition("=")
        if not equals:
            raise UsageError(f"'{assignment}' is not an assignment; write {assignment or 'field'}=value")
        _assign(message, kind, path, text)


def _assign(message: Any, kind: MessageType, path: str, text: str) -> None:
    *parents, last = path.split(".")
    for position, step in enumerate(parents):
        field, index = _step(kind, step, path)
        inner = field.type.element if isinstance(field.type, List) else field.type
        if not isinstance(inner, MessageType):
            raise UsageError(f"{'.'.join(parents[: position + 1])} of {kind.name} is {inner}, it has no fields")
        message = _inner_message(message, field, index, path)
        kind = inner
    field, index = _step(kind, last, path)
    if isinstance(field.type, List):
        _assign_element(getattr(message, field.name), field.type, index, path, text)
    elif index is not None:
        raise UsageError(f"{path}: {field.name} is {field.type} and no list")
    elif isinstance(field.type, MessageType) and not text:
        getattr(message, field.name).SetInParent()
    else:
        setattr(message, field.name, parse(field.type, text, path))


def _step(kind: MessageType, step: str, path: str) -> tuple[Field, int | None]:
    match = _STEP.fullmatch(step)
    if match is None:
        raise UsageError(f"'{path}' is not a field path; write it as x, bbox.x or points[0]")
    field = kind.field(match["name"])
    if field is None:
        hint = did_you_mean(match["name"], (known.name for known in kind.fields))
        raise UsageError(f"{kind.name} has no field '{match['name']}'" + (f"; {hint}" if hint else ""))
    return field, None if match["index"] is None else int(match["index"])


def _inner_message(message: Any, field: Field, index: int | None, path: str) -> Any:
    member = getattr(message, field.name)
    if not isinstance(field.type, List):
        if index is not None:
            raise UsageError(f"{path}: {field.name} is {field.type} and no list")
        member.SetInParent()
        return member
    if index is None:
        raise UsageError(f"{path}: {field.name} is a list; say which element, such as {field.name}[0]")
    _extend(member, field.type, index, path)
    return member[index]


def _assign_element(values: Any, kind: List, index: int | None, path: str, text: str) -> None:
    index = len(values) if index is None else index
    if isinstance(kind.element, MessageType) and not text:
        _extend(values, kind, index, path)
        return
    value = parse(kind.element, text, path)
    _extend(values, kind, index, path)
    values[index] = value


def _extend(values: Any, kind: List, index: int, path: str) -> None:
    """Make the list long enough for `index`; what was not said is the element's zero."""
    bound = kind.length if kind.length is not None else kind.bound
    limit = LARGEST_LIST if bound is None else bound
    if index >= limit:
        raise UsageError(f"{path}: {kind} holds at most {limit} elements")
    while len(values) <= index:
        if isinstance(kind.element, MessageType):
            values.add()
        else:
            values.append(_ZEROS[type(kind.element)])


_LARGEST = {32: 3.4028235e38, 64: sys.float_info.max}
_ZEROS: dict[type[Any], object] = {Bool: False, Int: 0, Enum: 0, Float: 0.0, String: "", Bytes: b""}


def parse(kind: Type, text: str, path: str) -> object:
    """The text as a value of a scalar type. `path` names the field in errors. Raises UsageError."""
    parser = _PARSERS.get(type(kind))
    if parser is None:
        raise UsageError(f"{path} is the message {kind}; set its fields, such as {path}.{_first_field(kind)}=...")
    return parser(kind, text, path)


def _first_field(kind: Type) -> str:
    return kind.fields[0].name if isinstance(kind, MessageType) and kind.fields else "x"


def _parse_bool(kind: Bool, text: str, path: str) -> bool:
    if text.lower() not in _TRUTH:
        raise UsageError(f"{path}: '{text}' is not a bool; write true or false")
    return _TRUTH[text.lower()]


def _parse_int(kind: Int, text: str, path: str) -> int:
    try:
        value = int(text, 0)
    except ValueError:
        raise UsageError(f"{path}: '{text}' is not an integer ({kind}); write it as 42, -1 or 0x2a") from None
    if not kind.low <= value <= kind.high:
        raise UsageError(f"{path}: {text} does not fit {kind}, which holds {kind.low} to {kind.high}")
    return value


def _parse_float(kind: Float, text: str, path: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise UsageError(f"{path}: '{text}' is not a number ({kind}); write it as 1.5, -2e3, nan or inf") from None
    largest = _LARGEST[kind.bits]
    if abs(value) > largest and "inf" not in text.lower():
        raise UsageError(f"{path}: {text} does not fit {kind}, which holds {-largest!r} to {largest!r}")
    return value


def _parse_enum(kind: Enum, text: str, path: str) -> int:
    """A name, qualified or not (`SensorState.SENSOR_ERROR`), or any int32: protobuf enums are open."""
    values = dict(kind.values)
    name = text.removeprefix(f"{kind.name}.").removeprefix(f"{kind.name.rpartition('.')[2]}.")
    if name in values:
        return values[name]
    if text.lstrip("-")[:1].isdigit():
        return _parse_int(ENUM_RANGE, text, path)
    raise UsageError(f"{path}: {kind.name} has no value '{text}'; {did_you_mean(name, values)}")


def _parse_string(kind: String, text: str, path: str) -> str:
    if kind.bound is not None and len(text.encode()) > kind.bound:
        raise UsageError(f"{path}: '{text}' has {len(text.encode())} bytes, {kind} holds at most {kind.bound}")
    return text


def _parse_bytes(kind: Bytes, text: str, path: str) -> bytes:
    try:
        value = bytes.fromhex(text.removeprefix("0x"))
    except ValueError:
        raise UsageError(f"{path}: '{text}' is not hex; write bytes as 0a1b2c") from None
    if kind.bound is not None and len(value) > kind.bound:
        raise UsageError(f"{path}: {len(value)} bytes do not fit {kind}, which holds at most {kind.bound}")
    return value


_PARSERS: dict[type[Any], Callable[[Any, str, str], object]] = {
    Bool: _parse_bool,
    Int: _parse_int,
    Float: _parse_float,
    Enum: _parse_enum,
    String: _parse_string,
    Bytes: _parse_bytes,
}
