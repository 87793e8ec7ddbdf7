"""Parses and formats message fields as `field=value` words, for all verbs.

`router send` parses these words; `tap`, `listen` and `sim` print them. For protobuf messages the two are inverse.
To print them, values of any source are first converted to a `Tree`.
"""

from __future__ import annotations

import base64
import json
import math
import re
import struct
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from typing import Any, NamedTuple, Union

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.json_format import Error as NoJsonError
from google.protobuf.json_format import MessageToDict
from google.protobuf.message import DecodeError, Message

from router.errors import UsageError, did_you_mean
from router.types.model import Bool, Bytes, Enum, Field, Float, Int, List, MessageType, String, Type
from router.types.protobuf import PayloadCase

# Parsing


def payload(case: PayloadCase, assignments: Sequence[str]) -> Message:
    """Return a payload with these `field=value` words applied. Raises UsageError."""
    message = case.message_class()
    set_fields(message, case.type, assignments)
    return message


def set_fields(message: Message, kind: MessageType, assignments: Sequence[str]) -> None:
    """Apply `path=value` words in order. A path is `x`, `bbox.x`, `points[1]`, `boxes[0].x` or `counts[left]`.

    The key of a map needs quotes, as in `counts["a.b"]`, unless it has only letters, digits, `_` and `-`. A list
    without an index is appended to; `bbox=` alone makes an empty message present. Raises UsageError.
    """
    for assignment in assignments:
        match = _ASSIGNMENT.fullmatch(assignment)
        if match is None:
            raise UsageError(f"'{assignment}' is not an assignment", f"write {assignment or 'field'}=value")
        _assign(message, kind, match["path"], match["text"])


_QUOTED = r'"(?:[^"\\]|\\.)*"'
_ASSIGNMENT = re.compile(rf"(?P<path>(?:[^=\"]|{_QUOTED})*)=(?P<text>.*)", re.DOTALL)
_DOT = re.compile(rf"\.(?=(?:[^\"]|{_QUOTED})*$)")  # outside of quotes
_STEP = re.compile(rf"(?P<name>\w+)(?:\[(?P<index>[\w-]+|{_QUOTED})\])?")


def _assign(message: Any, kind: MessageType, path: str, text: str) -> None:
    *parents, last = _DOT.split(path)
    for position, step in enumerate(parents):
        field, index = _step(kind, step, path)
        inner = _content(field.type)
        if not isinstance(inner, MessageType):
            here = ".".join(parents[: position + 1])
            if index is None and isinstance(field.type, List) and field.type.entry is not None:
                key = [*parents, last][position + 1]
                raise UsageError(f"{here} is a map", f"name a value, such as {here}[{key}]=...")
            raise UsageError(f"{here} of {kind.name} is {inner}, which has no fields")
        message = _inner_message(message, field, index, path)
        kind = inner
    field, index = _step(kind, last, path)
    if isinstance(field.type, List):
        _assign_element(getattr(message, field.name), field.type, index, path, text)
    elif index is not None:
        raise UsageError(f"{path}: {field.name} is {field.type}, not a list")
    elif isinstance(field.type, MessageType) and not text:
        getattr(message, field.name).SetInParent()
    else:
        setattr(message, field.name, parse(field.type, text, path))


def _content(kind: Type) -> Type:
    """Return the type of a list's elements, of a map's values, or of a single field."""
    if not isinstance(kind, List):
        return kind
    return kind.element if kind.entry is None else kind.entry.fields[1].type


def _step(kind: MessageType, step: str, path: str) -> tuple[Field, str | None]:
    """Return the field, and the index or key in brackets."""
    match = _STEP.fullmatch(step)
    if match is None:
        hint = "write it as x, bbox.x, points[0] or counts[key]: elements count from 0"
        raise UsageError(f"'{path}' is not a field path", hint)
    field = kind.field(match["name"])
    if field is None:
        hint = did_you_mean(match["name"], (known.name for known in kind.fields))
        raise UsageError(f"{kind.name} has no field '{match['name']}'", hint)
    return field, match["index"]


def _inner_message(message: Any, field: Field, index: str | None, path: str) -> Any:
    member = getattr(message, field.name)
    if not isinstance(field.type, List):
        if index is not None:
            raise UsageError(f"{path}: {field.name} is {field.type}, not a list")
        member.SetInParent()
        return member
    if index is None:
        what, example = "a list", path.replace(field.name, f"{field.name}[0]", 1)
        if field.type.entry is not None:
            what, example = "a map", path.replace(field.name, f"{field.name}[key]", 1)
        raise UsageError(f"{path}: {field.name} is {what}", f"name an element, such as {example}=...")
    if field.type.entry is not None:
        return member.get_or_create(_key(member, field.type, index, path))
    position = _position(index, path)
    _extend(member, field.type, position, path)
    return member[position]


def _assign_element(values: Any, kind: List, index: str | None, path: str, text: str) -> None:
    if kind.entry is not None:
        _assign_entry(values, kind, index, path, text)
        return
    is_whole = index is None and not isinstance(kind.element, (String, Bytes)) and re.search(r"^\[|,", text)
    if is_whole or (index is None and text and isinstance(kind.element, MessageType)):
        member = f".{kind.element.fields[0].name}" if isinstance(kind.element, MessageType) else ""
        hint = f"write each element: {path}[0]{member}=... {path}[1]{member}=..."
        raise UsageError(f"{path} is a list, {kind}, and '{text}' is no element of it", hint)
    position = len(values) if index is None else _position(index, path)
    if isinstance(kind.element, MessageType) and not text:
        _extend(values, kind, position, path)
        return
    value = parse(kind.element, text, path)
    _extend(values, kind, position, path)
    values[position] = value


def _assign_entry(values: Any, kind: List, index: str | None, path: str, text: str) -> None:
    if index is None:
        raise UsageError(f"{path} is a map", f"name a value, such as {path}[key]=...")
    key, content = _key(values, kind, index, path), _content(kind)
    if isinstance(content, MessageType) and not text:
        values.get_or_create(key)
    else:
        values[key] = parse(content, text, path)


def _position(index: str, path: str) -> int:
    if not index.isdecimal():
        raise UsageError(f"{path}: '{index}' is not an index", "elements are numbered from 0")
    return int(index)


def _key(values: Any, kind: List, text: str, path: str) -> Any:
    """Parse the key of a map, for which it has room."""
    assert kind.entry is not None  # noqa: S101 - it is a map
    try:
        key = parse(kind.entry.fields[0].type, json.loads(text) if text.startswith('"') else text, path)
    except json.JSONDecodeError as error:
        raise UsageError(f"{path}: {text} is not a key: {error.msg}", "quote it as in JSON") from error
    if key not in values:
        _check_room(kind, len(values), path)
    return key


LARGEST_LIST = 65_507
"""Maximum number of elements: no list has more than the largest datagram has bytes."""

_ZEROS: Mapping[type, object] = {Bool: False, Int: 0, Float: 0.0, String: "", Bytes: b""}


def zero(kind: Type) -> object:
    """Return the value of a scalar that is not set; of an enum, its first value."""
    return kind.values[0][1] if isinstance(kind, Enum) else _ZEROS[type(kind)]


def _extend(values: Any, kind: List, index: int, path: str) -> None:
    """Extend the list with zeros up to `index`."""
    _check_room(kind, index, path)
    while len(values) <= index:
        if isinstance(kind.element, MessageType):
            values.add()
        else:
            values.append(zero(kind.element))


def _check_room(kind: List, index: int, path: str) -> None:
    bound = kind.length if kind.length is not None else kind.bound
    limit = LARGEST_LIST if bound is None else bound
    if index >= limit:
        raise UsageError(f"{path}: {kind} holds at most {limit} elements")


_TRUTH = {"true": True, "1": True, "yes": True, "on": True, "false": False, "0": False, "no": False, "off": False}
_LARGEST = {32: 3.4028235e38, 64: sys.float_info.max}
_ENUM_RANGE = Int(32, signed=True)


def parse(kind: Type, text: str, path: str) -> object:
    """Parse a value of a scalar type. `path` names the field in errors. Raises UsageError."""
    match kind:
        case Bool():
            if text.lower() not in _TRUTH:
                raise UsageError(f"{path}: '{text}' is not a bool", "write true or false")
            return _TRUTH[text.lower()]
        case Int():
            return _parse_int(kind, text, path)
        case Float():
            return _parse_float(kind, text, path)
        case Enum():
            return _parse_enum(kind, text, path)
        case String(bound=bound):
            if bound is not None and len(text.encode()) > bound:
                raise UsageError(f"{path}: '{text}' has {len(text.encode())} bytes, {kind} holds at most {bound}")
            return text
        case Bytes():
            return _parse_bytes(kind, text, path)
        case _:
            field = kind.fields[0].name if isinstance(kind, MessageType) and kind.fields else "x"
            raise UsageError(f"{path} is the message {kind}", f"set its fields, such as {path}.{field}=...")


def _parse_int(kind: Int, text: str, path: str) -> int:
    try:
        value = int(text, 0)
    except ValueError:
        raise UsageError(f"{path}: '{text}' is not an integer ({kind})", "write it as 42, -1 or 0x2a") from None
    if not kind.low <= value <= kind.high:
        raise UsageError(f"{path}: {text} does not fit {kind}, which holds {kind.low} to {kind.high}")
    return value


def _parse_float(kind: Float, text: str, path: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise UsageError(f"{path}: '{text}' is not a number ({kind})", "write it as 1.5, -2e3, nan or inf") from None
    largest = _LARGEST[kind.bits]
    if abs(value) > largest and "inf" not in text.lower():
        raise UsageError(f"{path}: {text} does not fit {kind}, which holds {-largest!r} to {largest!r}")
    return value


def _parse_enum(kind: Enum, text: str, path: str) -> int:
    """Parse a name, qualified or not (`SensorState.SENSOR_ERROR`), or a number: any int32 for an open enum."""
    values = dict(kind.values)
    name = text.removeprefix(f"{kind.name}.").removeprefix(f"{kind.name.rpartition('.')[2]}.")
    if name in values:
        return values[name]
    if text.lstrip("-")[:1].isdigit():
        number = _parse_int(_ENUM_RANGE, text, path)
        if not kind.is_closed or number in values.values():
            return number
    raise UsageError(f"{path}: {kind.name} has no value '{text}'", did_you_mean(name, values))


def _parse_bytes(kind: Bytes, text: str, path: str) -> bytes:
    try:
        value = bytes.fromhex(text.removeprefix("0x"))
    except ValueError:
        raise UsageError(f"{path}: '{text}' is not hex", "write bytes as 0a1b2c") from None
    if kind.bound is not None and len(value) > kind.bound:
        raise UsageError(f"{path}: {len(value)} bytes do not fit {kind}, which holds at most {kind.bound}")
    return value


# Printing


Tree = Union[str, Mapping[str, "Tree"]]
"""The text of a scalar or of a list of scalars; or the members of a message by name, with `x[0]` for an element."""


def words(tree: Tree, path: str = "") -> Iterator[str]:
    """Yield `path=value` for each text in the tree, and `path=` for an empty message."""
    if isinstance(tree, str):
        yield f"{path}={tree}"
    elif tree or not path:
        for name, member in tree.items():
            yield from words(member, f"{path}.{name}" if path else name)
    else:
        yield f"{path}="


def list_text(first: Iterable[str], length: int, limit: int) -> str:
    """Return `[1,2]` with at most `limit` elements; `[1,2,...](360)` if there are more."""
    listed = ",".join(first)
    return f"[{listed},...]({length})" if length > limit else f"[{listed}]"


def one_line(listed: Iterable[str], empty: str = "(all default)") -> str:
    """Return the words as one line, or `empty`."""
    return " ".join(word if word.isprintable() and " " not in word else repr(word) for word in listed) or empty


def compact(message: Message, kind: MessageType, digits: int | None = None) -> str:
    """Format a protobuf message on one line, with only the fields that are set."""
    return one_line(words(protobuf_tree(message, kind, digits)))


def scalar_text(value: Any, kind: Type, digits: int | None = None) -> str:
    """Format a scalar of this type: an enum by name, bytes as hex. `digits` as in float_text."""
    if isinstance(kind, Enum):
        return next((name for name, number in kind.values if number == value), str(value))
    return plain_text(value, kind.bits if isinstance(kind, Float) else 64, digits)


def plain_text(value: object, bits: int = 64, digits: int | None = None) -> str:
    """Format a scalar by its Python type. `bits` is the width of a float, `digits` as in float_text."""
    match value:
        case bool():
            return "true" if value else "false"
        case None:
            return "null"
        case float():
            return float_text(value, bits, digits)
        case bytes():
            return value.hex()
        case _:
            return str(value)


def float_text(value: float, bits: int, digits: int | None = None) -> str:
    """Return the shortest decimal that parses as the same float of this width.

    With `digits`, round to that many digits, and to twice as many for 64 bits: a degree of latitude is 111 km.
    """
    if digits is not None:
        return f"{value:.{digits * bits // 32}g}"
    if not math.isfinite(value):
        return str(value)
    if bits == 64:
        return repr(value)
    packed = struct.pack("<f", value)
    return next(text for p in range(6, 10) if struct.pack("<f", float(text := f"{value:.{p}g}")) == packed)


def time_text(at: datetime) -> str:
    """Return a time of day with milliseconds."""
    return f"{at:%H:%M:%S.%f}"[:-3]


def clock_text(at: datetime) -> str:
    """Return a time of day with milliseconds and its offset from UTC: `10:15:00.123+0530`."""
    return f"{time_text(at)}{at:%z}"


def age_text(seconds: float | None) -> str:
    """Format an age: `0.3 s`, `12 s`, `7 min`, `3 h`; `never` for None."""
    if seconds is None:
        return "never"
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.0f} h"


def rate_text(rate: float) -> str:
    """Format a rate per second, in at most four characters up to 9999."""
    return f"{rate:.1f}" if 0 < rate < 9.95 else f"{rate:.0f}"


def shortened(name: str, letters: int) -> str:
    """Cut the middle out of a name that is too long: names mostly differ at their ends."""
    if len(name) <= letters:
        return name
    kept = letters - 1
    return f"{name[: kept - kept // 2]}…{name[len(name) - kept // 2 :]}"


def protobuf_tree(message: Any, kind: MessageType, digits: int | None = None) -> Mapping[str, Tree]:
    """Return the fields of a protobuf message that are set. Each element of a list is a member: `x[0]`."""
    tree: dict[str, Tree] = {}
    for field in kind.fields:
        value = getattr(message, field.name)
        if isinstance(field.type, List):
            for index, element in _indexed(field.type, value):
                tree[f"{field.name}[{index}]"] = _protobuf_value(element, _content(field.type), digits)
        elif isinstance(field.type, MessageType) or field.has_presence:
            if message.HasField(field.name):
                tree[field.name] = _protobuf_value(value, field.type, digits)
        elif value or _is_negative_zero(value):
            tree[field.name] = scalar_text(value, field.type, digits)
    return tree


def _protobuf_value(value: Any, kind: Type, digits: int | None) -> Tree:
    return protobuf_tree(value, kind, digits) if isinstance(kind, MessageType) else scalar_text(value, kind, digits)


def _indexed(kind: List, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the elements of a list with their indexes, or the values of a map with their keys."""
    if kind.entry is None:
        yield from ((str(index), element) for index, element in enumerate(value))
        return
    for key, content in elements(kind, value):
        text = plain_text(key)
        yield text if _BARE_KEY.fullmatch(text) else json.dumps(text, ensure_ascii=False), content


_BARE_KEY = re.compile(r"[\w-]+")


class Entry(NamedTuple):
    """One entry of a protobuf map."""

    key: Any
    value: Any


def elements(kind: List, value: Any) -> Sequence[Any]:
    """Return the elements of a list; for a protobuf map, its entries sorted by key."""
    if kind.entry is not None:  # its own order differs from run to run
        return [Entry(key, value[key]) for key in sorted(_readable(value))]
    found: Sequence[Any] = value
    return found


def _readable(keys: Iterable[Any]) -> Iterator[Any]:
    """Yield the keys of a protobuf map except text that is not UTF-8, as proto2 allows: protobuf cannot look it up."""
    return (key for key in keys if not isinstance(key, bytes))


def protobuf_json(message: Message, *, complete: bool = False) -> Any:
    """Return a protobuf message in the JSON mapping, with the names of the `.proto` files.

    A message in it that has no such form is a dict of its fields: a Timestamp out of range, an Any of an unknown type.
    `complete`: including fields without presence that are not set.
    """
    descriptor: Any = message.DESCRIPTOR
    try:
        return MessageToDict(
            message,
            preserving_proto_field_name=True,
            always_print_fields_with_no_presence=complete,
            descriptor_pool=descriptor.file.pool,
        )
    except (NoJsonError, ValueError, TypeError, DecodeError, RecursionError):  # all occur, depending on the type
        fields = dict(message.ListFields())
        if complete:
            absent = (field for field in descriptor.fields if not field.has_presence and field not in fields)
            fields |= {field: getattr(message, field.name) for field in absent}
        return {
            f"[{field.full_name}]" if field.is_extension else field.name: _json_field(field, value, complete=complete)
            for field, value in fields.items()
        }


def _json_field(field: FieldDescriptor, value: Any, *, complete: bool) -> Any:
    if not field.is_repeated:
        return _json_value(field, value, complete=complete)
    if field.message_type is not None and field.message_type.GetOptions().map_entry:
        content = field.message_type.fields_by_name["value"]
        return {plain_text(key): _json_value(content, value[key], complete=complete) for key in _readable(value)}
    return [_json_value(field, element, complete=complete) for element in value]


def _json_value(field: FieldDescriptor, value: Any, *, complete: bool) -> Any:
    """Return a value in protobuf's JSON mapping."""
    if field.message_type is not None:
        return protobuf_json(value, complete=complete)
    if field.enum_type is not None:
        known = field.enum_type.values_by_number.get(value)
        return value if known is None else known.name
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    if isinstance(value, float):
        bits = 64 if field.type == FieldDescriptor.TYPE_DOUBLE else 32
        return _json_float(float(float_text(value, bits)))
    return str(value) if field.cpp_type in _WIDE else value


_WIDE = (FieldDescriptor.CPPTYPE_INT64, FieldDescriptor.CPPTYPE_UINT64)
"""The types that JSON's numbers cannot hold."""


def _json_float(value: float) -> float | str:
    """Return a float as in protobuf's JSON mapping."""
    if math.isfinite(value):
        return value
    return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"


def _is_negative_zero(value: Any) -> bool:
    """Return whether a value is -0.0, which protobuf writes although it equals the default."""
    return isinstance(value, float) and math.copysign(1.0, value) < 0


SHOWN_ELEMENTS = 8
"""Maximum number of elements shown of a list in a ROS message; an image has a million."""


def ros_tree(message: Any) -> Mapping[str, Tree]:
    """Return the fields of an rclpy message that are not zero or empty, and the first elements of lists."""
    tree: dict[str, Tree] = {}
    for name, spelled in message.get_fields_and_field_types().items():
        value = getattr(message, name)
        if not _is_array(value):
            member = _ros_value(value, spelled)
            if member and value not in (0, "", b"\0"):
                tree[name] = member
        elif any(value):
            first = _as_list(value[:SHOWN_ELEMENTS])
            shown = [_ros_value(element, spelled) for element in first]
            if not _is_ros_message(first[0]):
                tree[name] = list_text(shown, len(value), SHOWN_ELEMENTS)
                continue
            tree.update({f"{name}[{index}]": element for index, element in enumerate(shown) if element})
            if len(value) > len(first):
                tree[name] = f"...({len(value)})"
    return tree


def _ros_value(value: Any, spelled: str) -> Any:
    """Convert a value; `spelled` is the field's type as rclpy spells it: `float`, `sequence<double, 5>`, `uint8[4]`."""
    if _is_ros_message(value):
        return ros_tree(value)
    octet = value[0] if isinstance(value, bytes) else value
    return plain_text(octet, 64 if "double" in spelled else 32)


def ros_json(value: Any) -> Any:
    """Return an rclpy message as a dict, an array as a list; NaN and infinities as in protobuf's JSON mapping."""
    if _is_ros_message(value):
        return {name: ros_json(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if _is_array(value):
        return [ros_json(element) for element in _as_list(value)]
    if isinstance(value, float):
        return _json_float(value)
    return value[0] if isinstance(value, bytes) else value


def _is_ros_message(value: Any) -> bool:
    return hasattr(value, "get_fields_and_field_types")


def _is_array(value: Any) -> bool:
    """Return whether the value is a list, an array.array or a numpy array."""
    return hasattr(value, "__len__") and not isinstance(value, (str, bytes))


def _as_list(array: Any) -> list[Any]:
    """Return the elements as Python numbers."""
    return array.tolist() if hasattr(array, "tolist") else list(array)
