"""Reads values that people write: scalars of any type, and payloads as `field=value` words.

Before it becomes a message, a payload is plain: dicts for messages and maps, lists for lists.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from google.protobuf.message import Message

from router.errors import UsageError, did_you_mean
from router.types.model import Bool, Bytes, Enum, Field, Float, Int, List, MessageType, String, Type, default_of, zero
from router.types.protobuf import PayloadCase

# Messages


def payload(case: PayloadCase, assignments: Sequence[str]) -> Message:
    """Return a payload with these words applied, as `assigned`."""
    return assigned(case.message_class(), case.type, assignments)


def assigned(message: Message, kind: MessageType, assignments: Sequence[str]) -> Message:
    """Set fields of a message by words, as in `members_of`. Return it. Raises UsageError."""
    return filled(message, members_of(kind, assignments))


def members_of(kind: MessageType, assignments: Sequence[str]) -> dict[str, Any]:
    """Return the fields of a message that `path=value` words set, applied in order. Raises UsageError.

    A path is `x`, `bbox.x`, `points[1]`, `boxes[0].x` or `counts[left]`. The key of a map needs quotes, as in
    `counts["a.b"]`, unless it has only letters, digits, `_` and `-`. A list without an index is appended to; `bbox=`
    alone makes an empty message present.
    """
    members: dict[str, Any] = {}
    for assignment in assignments:
        match = _ASSIGNMENT.fullmatch(assignment)
        if match is None:
            raise UsageError(f"'{assignment}' is not an assignment", f"write {assignment or 'field'}=value")
        _assign(members, kind, match["path"], match["text"])
    return members


def completed(kind: Type, value: Any) -> Any:
    """Return a ROS value with the default of each field, and each element of a list of fixed length, that it lacks."""
    match kind:
        case MessageType():
            return {
                field.name: completed(field.type, value[field.name])
                if field.name in value
                else default_of(field.type, field.default)
                for field in kind.fields
            }
        case List():
            missing = (kind.length or 0) - len(value)
            return [completed(kind.element, item) for item in value] + [default_of(kind.element)] * missing
    return value


def filled(message: Message, members: Mapping[str, Any]) -> Message:
    """Return a protobuf message with these fields set.

    Its constructor does not take every dict for a message: that of a Struct are its `fields`.
    """
    for name, value in members.items():
        field: Any = getattr(message, name)
        if isinstance(field, Message):
            field.SetInParent()
            filled(field, value)
        elif isinstance(value, dict):
            for key, content in value.items():
                if isinstance(content, dict):
                    filled(field[key], content)
                else:
                    field[key] = content
        elif isinstance(value, list):
            for element in value:
                if isinstance(element, dict):
                    filled(field.add(), element)
                else:
                    field.append(element)
        else:
            setattr(message, name, value)
    return message


_QUOTED = r'"(?:[^"\\]|\\.)*"'
_ASSIGNMENT = re.compile(rf"(?P<path>(?:[^=\"]|{_QUOTED})*)=(?P<text>.*)", re.DOTALL)
_DOT = re.compile(rf"\.(?=(?:[^\"]|{_QUOTED})*$)")  # outside of quotes
_STEP = re.compile(rf"(?P<name>\w+)(?:\[(?P<index>[\w-]+|{_QUOTED})\])?")


def _assign(members: dict[str, Any], kind: MessageType, path: str, text: str) -> None:
    steps = _DOT.split(path)
    for position, step in enumerate(steps[:-1], 1):
        field, index = _step(kind, step, path)
        inner = _content(field.type)
        if not isinstance(inner, MessageType):
            here = ".".join(steps[:position])
            if index is None and _is_map(field.type):
                raise UsageError(f"{here} is a map", f"name a value, such as {here}[{steps[position]}]=...")
            raise UsageError(f"{here} of {kind.name} is {inner}, which has no fields")
        if index is None and isinstance(field.type, List):
            what, example = ("a map", "[key]") if _is_map(field.type) else ("a list", "[0]")
            example = path.replace(field.name, field.name + example, 1)
            raise UsageError(f"{path}: {field.name} is {what}", f"name an element, such as {example}=...")
        holder, key = _slot(members, kind, field, index, path)
        members, kind = holder[key], inner
    field, index = _step(kind, steps[-1], path)
    inner = _content(field.type)
    if index is None and isinstance(field.type, List):
        _check_element(field.type, path, text)
    holder, key = _slot(members, kind, field, index, path)
    if not isinstance(inner, MessageType):
        holder[key] = _parse(inner, text, path)
    elif text:
        raise UsageError(f"{path} is the message {inner}", f"set its fields, such as {path}{_first_field(inner)}=...")


def _first_field(kind: Type) -> str:
    """Return what names a field of a message in an example: `.x`; "" for a scalar."""
    if not isinstance(kind, MessageType):
        return ""
    return f".{kind.fields[0].name}" if kind.fields else ".x"


def _parse(kind: Type, text: str, path: str) -> object:
    try:
        return parse(kind, text)
    except UsageError as error:
        raise UsageError(f"{path}: {error.what}", error.hint) from error


def _content(kind: Type) -> Type:
    """Return the type of a list's elements, of a map's values, or of a single field."""
    return kind.content if isinstance(kind, List) else kind


def _is_map(kind: Type) -> bool:
    return isinstance(kind, List) and kind.entry is not None


def member(kind: MessageType, name: str) -> Field:
    """Return the field of a message. Raises UsageError if there is none of this name."""
    field = kind.field(name)
    if field is None:
        raise UsageError(f"{kind} has no field '{name}'", did_you_mean(name, (known.name for known in kind.fields)))
    return field


def _step(kind: MessageType, step: str, path: str) -> tuple[Field, str | None]:
    """Return the field, and the index or key in brackets."""
    match = _STEP.fullmatch(step)
    if match is None:
        hint = "write it as x, bbox.x, points[0] or counts[key]: elements count from 0"
        raise UsageError(f"'{path}' is not a field path", hint)
    return member(kind, match["name"]), match["index"]


def _check_element(kind: List, path: str, text: str) -> None:
    """Raise UsageError unless the text can be appended to a list as one element."""
    if kind.entry is not None:
        raise UsageError(f"{path} is a map", f"name a value, such as {path}[key]=...")
    is_message = isinstance(kind.element, MessageType)
    if (is_message and text) or (not isinstance(kind.element, (String, Bytes)) and re.search(r"^\[|,", text)):
        example = _first_field(kind.element)
        hint = f"write each element: {path}[0]{example}=... {path}[1]{example}=..."
        raise UsageError(f"{path} is a list, {kind}, and '{text}' is no element of it", hint)


def _slot(members: dict[str, Any], kind: MessageType, field: Field, index: str | None, path: str) -> tuple[Any, Any]:
    """Return the dict or list that holds a value, and the key of the value there.

    A message, and the elements up to this one, then exist. The other members of a oneof are removed.
    """
    if field.oneof is not None:
        for other in kind.fields:
            if other.oneof == field.oneof and other is not field:
                members.pop(other.name, None)
    if isinstance(field.type, List) and field.type.entry is None:
        elements = members.setdefault(field.name, [])
        position = len(elements) if index is None else _position(index, path)
        _check_room(field.type, position + 1, path)
        while len(elements) <= position:
            elements.append({} if isinstance(field.type.element, MessageType) else zero(field.type.element))
        return elements, position
    holder: dict[Any, Any] = members
    key: object = field.name
    if isinstance(field.type, List):
        holder, key = members.setdefault(field.name, {}), _key(field.type, index or "", path)
        _check_room(field.type, len(holder) + (key not in holder), path)
    elif index is not None:
        raise UsageError(f"{path}: {field.name} is {field.type}, not a list")
    if isinstance(_content(field.type), MessageType):
        holder.setdefault(key, {})
    return holder, key


def _position(index: str, path: str) -> int:
    if not index.isdecimal():
        raise UsageError(f"{path}: '{index}' is not an index", "elements are numbered from 0")
    return int(index)


def _key(kind: List, text: str, path: str) -> object:
    """Parse the key of a map."""
    assert kind.entry is not None  # noqa: S101 - it is a map
    try:
        return _parse(kind.entry.fields[0].type, json.loads(text) if text.startswith('"') else text, path)
    except json.JSONDecodeError as error:
        raise UsageError(f"{path}: {text} is not a key: {error.msg}", "quote it as in JSON") from error


LARGEST_LIST = 65_507
"""Maximum number of elements: no list has more than the largest datagram has bytes."""


def _check_room(kind: List, count: int, path: str) -> None:
    """Raise UsageError if a list cannot hold so many elements."""
    bound = kind.length if kind.length is not None else kind.bound
    limit = LARGEST_LIST if bound is None else bound
    if count > limit:
        raise UsageError(f"{path}: {kind} holds at most {limit} elements")


# Scalars


_TRUTH = {"true": True, "1": True, "yes": True, "on": True, "false": False, "0": False, "no": False, "off": False}
_LARGEST = {32: 3.4028235e38, 64: sys.float_info.max}
_ENUM_RANGE = Int(32, signed=True)


def parse(kind: Type, text: str) -> object:
    """Parse a value of a scalar type. Raises UsageError."""
    match kind:
        case Bool():
            if text.lower() not in _TRUTH:
                raise UsageError(f"'{text}' is not a bool", "write true or false")
            return _TRUTH[text.lower()]
        case Int():
            return _parse_int(kind, text)
        case Float():
            return _parse_float(kind, text)
        case Enum():
            return _parse_enum(kind, text)
        case String(bound=bound):
            if bound is not None and len(text.encode()) > bound:
                raise UsageError(f"'{text}' has {len(text.encode())} bytes, {kind} holds at most {bound}")
            return text
        case Bytes():
            return _parse_bytes(kind, text)
        case _:
            raise TypeError(f"{kind} is not a scalar type")


def _parse_int(kind: Int, text: str) -> int:
    try:
        value = int(text, 0)
    except ValueError:
        raise UsageError(f"'{text}' is not an integer ({kind})", "write it as 42, -1 or 0x2a") from None
    if not kind.low <= value <= kind.high:
        raise UsageError(f"{text} does not fit {kind}, which holds {kind.low} to {kind.high}")
    return value


def _parse_float(kind: Float, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise UsageError(f"'{text}' is not a number ({kind})", "write it as 1.5, -2e3, nan or inf") from None
    largest = _LARGEST[kind.bits]
    if abs(value) > largest and "inf" not in text.lower():
        raise UsageError(f"{text} does not fit {kind}, which holds {-largest!r} to {largest!r}")
    return value


def _parse_enum(kind: Enum, text: str) -> int:
    """Parse a name, qualified or not (`SensorState.SENSOR_ERROR`), or a number: any int32 for an open enum."""
    values = dict(kind.values)
    name = text.removeprefix(f"{kind.name}.").removeprefix(f"{kind.name.rpartition('.')[2]}.")
    if name in values:
        return values[name]
    if text.lstrip("-")[:1].isdigit():
        number = _parse_int(_ENUM_RANGE, text)
        if not kind.is_closed or number in values.values():
            return number
    raise UsageError(f"{kind.name} has no value '{text}'", did_you_mean(name, values))


def _parse_bytes(kind: Bytes, text: str) -> bytes:
    try:
        value = bytes.fromhex(text.removeprefix("0x"))
    except ValueError:
        raise UsageError(f"'{text}' is not hex", "write bytes as 0a1b2c") from None
    if kind.bound is not None and len(value) > kind.bound:
        raise UsageError(f"{len(value)} bytes do not fit {kind}, which holds at most {kind.bound}")
    return value
