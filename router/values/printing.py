"""Prints messages and values: as `field=value` words, as JSON, and as short texts for tables.

To print words, values of any source are first converted to a `Tree`. `reading.payload` reads the words of a protobuf
message again.
"""

from __future__ import annotations

import base64
import json
import math
import re
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from typing import Any, NamedTuple, Union

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.json_format import Error as NoJsonError
from google.protobuf.json_format import MessageToDict
from google.protobuf.message import DecodeError, Message

from router.types.model import Enum, Float, List, MessageType, Type

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
                tree[f"{field.name}[{index}]"] = _protobuf_value(element, field.type.content, digits)
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
    listed: Sequence[Any] = value
    return listed


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


def ros_tree(message: Any, *, complete: bool = False) -> Mapping[str, Tree]:
    """Return the fields of an rclpy message that are not zero or empty, and the first elements of lists.

    `complete`: including those that are zero or empty.
    """
    tree: dict[str, Tree] = {}
    for name, spelled in message.get_fields_and_field_types().items():
        value = getattr(message, name)
        if not _is_array(value):
            member = _ros_value(value, spelled, complete=complete)
            if complete or (member and value not in (0, "", b"\0")):
                tree[name] = member
        elif complete or any(value):
            first = _as_list(value[:SHOWN_ELEMENTS])
            shown = [_ros_value(element, spelled, complete=complete) for element in first]
            if not first or not _is_ros_message(first[0]):
                tree[name] = list_text(shown, len(value), SHOWN_ELEMENTS)
                continue
            tree.update({f"{name}[{index}]": element for index, element in enumerate(shown) if element})
            if len(value) > len(first):
                tree[name] = f"...({len(value)})"
    return tree


def _ros_value(value: Any, spelled: str, *, complete: bool) -> Any:
    """Convert a value; `spelled` is the field's type as rclpy spells it: `float`, `sequence<double, 5>`, `uint8[4]`."""
    if _is_ros_message(value):
        return ros_tree(value, complete=complete)
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
