"""A message as a table test writes it, given or expected, and where an actual message differs from it.

A message here is anything with its fields as attributes: a protobuf message, or what `cdr.deserialize` returns.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Union

from google.protobuf.message import Message

from router.compiler.expressions.functions import NS_PER_SECOND
from router.compiler.expressions.kinds import STAMP_TYPES
from router.errors import Code, SourceSpan, UsageError
from router.rehearsal.rehearsal import START
from router.table.compose import resolve
from router.table.nodes import Entry, MappingNode, Node, ScalarNode, SequenceNode
from router.table.reading import InvalidValueError, is_text
from router.table.units import duration, parse_duration
from router.types.model import Bool, Bytes, Field, Float, Int, List, MessageType, String, Type, default_of
from router.values.printing import elements, scalar_text
from router.values.reading import filled, member, parse

ANY = "any"
RECEIVED_AT = "received_at"

Path = tuple[Union[str, int], ...]


@dataclass(frozen=True, slots=True)
class Difference:
    """One field that differs from what was expected; `span` is the place that expects it."""

    path: Path
    expected: str
    actual: str
    span: SourceSpan

    def __str__(self) -> str:
        return f"{path_text(self.path)} is {self.actual}, not {self.expected}"


# What a test says. `differences` compares it with an actual value; `now` is when the step's message arrived, ns.


@dataclass(frozen=True, slots=True)
class AnyValue:
    span: SourceSpan

    def differences(self, path: Path, kind: Type, actual: Any, now: int) -> Iterator[Difference]:
        """Yield nothing: any value is accepted."""
        yield from ()


@dataclass(frozen=True, slots=True)
class Scalar:
    """A scalar (for a float32, the nearest one), or a number with a `tolerance`, written as `text`."""

    value: Any
    span: SourceSpan
    tolerance: float | None = None
    text: str = ""

    def differences(self, path: Path, kind: Type, actual: Any, now: int) -> Iterator[Difference]:
        if self.tolerance is None:
            if not _same(kind, self.value, actual):
                yield Difference(path, shown(kind, self.value), shown(kind, actual), self.span)
            return
        slack = 4 * math.ulp(self.value)  # the ends of the interval are written in decimal
        if not abs(actual - self.value) <= self.tolerance + slack:
            yield Difference(path, self.text, shown(kind, actual), self.span)


@dataclass(frozen=True, slots=True)
class Time:
    """A message of STAMP_TYPES: `offset` ns after the test's start, or None for the arrival of the message."""

    type: MessageType
    offset: int | None
    span: SourceSpan

    def at(self, now: int) -> int:
        return now if self.offset is None else START + self.offset

    def differences(self, path: Path, kind: Type, actual: Any, now: int) -> Iterator[Difference]:
        expected, stamp = self.at(now), _time_of(self.type, actual)
        if stamp != expected:
            yield Difference(path, offset(expected - START), offset(stamp - START), self.span)


@dataclass(frozen=True, slots=True)
class Fields:
    """A message of this type; all other fields are at their default."""

    type: MessageType
    members: Mapping[str, FieldValue]
    span: SourceSpan

    def differences(self, path: Path, kind: Type, actual: Any, now: int) -> Iterator[Difference]:
        for field in self.type.fields:
            member = self.members.get(field.name)
            value = getattr(actual, field.name)
            here = (*path, field.name)
            if member is not None:
                yield from member.differences(here, field.type, value, now)
            elif not _is_unset(actual, field, value):
                yield Difference(here, "at its default", shown(field.type, value), self.span)


@dataclass(frozen=True, slots=True)
class Elements:
    """The elements of a list, or the entries of a protobuf map in the order of their keys."""

    items: tuple[FieldValue, ...]
    span: SourceSpan

    def differences(self, path: Path, kind: Type, actual: Any, now: int) -> Iterator[Difference]:
        assert isinstance(kind, List)  # noqa: S101 - it was read as one
        if len(actual) != len(self.items):
            content = f"{len(actual)} elements {shown(kind, actual)}" if len(actual) else "empty"
            yield Difference(path, f"{len(self.items)} elements", content, self.span)
            return
        for index, (item, value) in enumerate(zip(self.items, elements(kind, actual), strict=True)):
            yield from item.differences((*path, index), kind.element, value, now)


FieldValue = Union[AnyValue, Scalar, Time, Fields, Elements]


# Reading them


_ROUGHLY = re.compile(r"~ ?([-+]?[0-9]+(?:\.([0-9]*))?(?:[eE]([-+]?[0-9]+))?)")
_WITHIN = re.compile(r"(\S+) *(?:\+-|\+/-|±) *(\S+)")


class FieldReader:
    """Reads the fields of messages. With `exact`, as for given messages, `any` and tolerances are not allowed.

    `constants` are the numbers of enum values by name; several if enums share a name. The word `any` means any value
    only without quotes; in quotes it is text. A value that does not fit its type raises InvalidValueError at its place.
    """

    def __init__(self, constants: Mapping[str, set[int]], *, exact: bool) -> None:
        self._constants = constants
        self._exact = exact

    def message(self, kind: MessageType, node: Node) -> Fields:
        if not isinstance(node, MappingNode):
            message = f"{kind} is a message: write its fields, {{name: value}}"
            raise InvalidValueError(node.span, Code.WRONG_TYPE, message)
        members: dict[str, FieldValue] = {}
        for path, entry in node.entries.items():
            self._put(members, kind, path, entry)
        return Fields(kind, members, node.span)

    def _put(self, members: dict[str, FieldValue], kind: MessageType, path: str, entry: Entry) -> None:
        """Add the value of a path such as `header.stamp` to the members of a message."""
        span = entry.key.span
        name, dot, rest = path.partition(".")
        try:
            field = member(kind, name)
        except UsageError as error:
            hint = "write a list as a whole: [a, b]" if kind.field(name.partition("[")[0]) else error.hint
            raise InvalidValueError(span, Code.UNKNOWN_FIELD, error.what, hint) from error
        if dot and not isinstance(field.type, MessageType):
            is_list = isinstance(field.type, List) and isinstance(field.type.element, MessageType)
            hint = f"write its elements: {name}: [{{{rest}: VALUE}}]" if is_list else ""
            raise InvalidValueError(span, Code.UNKNOWN_FIELD, f"'{name}' is {field.type} and has no fields", hint)
        inner = members.get(name)
        if inner is not None and not (dot and isinstance(inner, Fields)):
            raise InvalidValueError(span, Code.DUPLICATE_FIELD, f"'{name}' is given twice")
        if dot and isinstance(field.type, MessageType):
            below = dict(inner.members) if isinstance(inner, Fields) else {}
            self._put(below, field.type, rest, entry)
            members[name] = Fields(field.type, below, span)
        else:
            members[name] = self._value(field.type, entry.value, kind)

    def _value(self, kind: Type, node: Node, holder: MessageType) -> FieldValue:
        if not self._exact and isinstance(node, ScalarNode) and node.text == ANY and node.text_span.is_whole_line:
            return AnyValue(node.span)
        match kind, node:
            case MessageType(), ScalarNode() if kind.name in STAMP_TYPES:
                return Time(kind, _offset(node), node.span)
            case MessageType(fields=(only,)), ScalarNode():  # as a table fills it
                return Fields(kind, {only.name: self._value(only.type, node, kind)}, node.span)
            case MessageType(), _:
                return self.message(kind, node)
            case List(), _:
                return self._list(kind, node, holder)
            case _, ScalarNode():
                return self._scalar(kind, node, holder)
        hint = "write the text itself" if is_text(node) else ""
        raise InvalidValueError(node.span, Code.WRONG_TYPE, f"a {kind} takes one value", hint)

    def _list(self, kind: List, node: Node, holder: MessageType) -> Elements:
        if isinstance(node, SequenceNode):
            if kind.length is not None and len(node.items) != kind.length:
                message = f"{kind} has {kind.length} elements, not {len(node.items)}"
                raise InvalidValueError(node.span, Code.TYPE_MISMATCH, message)
            return Elements(tuple(self._value(kind.element, item, holder) for item in node.items), node.span)
        if kind.entry is None:
            raise InvalidValueError(node.span, Code.WRONG_TYPE, f"{kind} is a list: write [a, b]")
        if not isinstance(node, MappingNode):
            raise InvalidValueError(node.span, Code.WRONG_TYPE, "this is a map: write {key: value}")
        return self._entries(kind.entry, node)

    def _entries(self, kind: MessageType, node: MappingNode) -> Elements:
        """Read the entries of a protobuf map, written as `{key: value}`."""
        key, value = kind.fields
        read = [
            (self._scalar(key.type, entry.key, kind), self._value(value.type, entry.value, kind))
            for entry in node.entries.values()
        ]
        read.sort(key=lambda item: item[0].value)
        items = (Fields(kind, {key.name: name, value.name: content}, name.span) for name, content in read)
        return Elements(tuple(items), node.span)

    def _scalar(self, kind: Type, node: ScalarNode, holder: MessageType) -> Scalar:
        text = node.text
        _refuse_other_type(kind, node)
        if isinstance(kind, (Int, Float)) and not self._exact and (near := _near(text, node.span)):
            return near
        if isinstance(kind, Int) and (number := self._constant(text, holder, node.span)) is not None:
            text = str(number)
        if isinstance(kind, Bytes):
            text = text.replace(" ", "")
        try:
            return Scalar(parse(kind, text), node.span)
        except UsageError as error:
            raise InvalidValueError(node.span, Code.BAD_VALUE, str(error)) from error

    def _constant(self, text: str, holder: MessageType, span: SourceSpan) -> int | None:
        """Return the value of a ROS constant of the message (`STATUS_FIX`), or of an enum (`GPSFixQuality.RTK_FIX`)."""
        constant = holder.constants.get(text.removeprefix(f"{holder.short_name}."))
        if isinstance(constant, int):
            return constant
        numbers = self._constants.get(text, set())
        if len(numbers) > 1:
            message = f"several enums have a value '{text}', with different numbers"
            raise InvalidValueError(span, Code.BAD_VALUE, message, f"name the enum, as in State.{text}")
        return next(iter(numbers), None)


def _refuse_other_type(kind: Type, node: ScalarNode) -> None:
    """Raise InvalidValueError for a quoted number or truth value, and for a number in place of a truth value."""
    if isinstance(kind, (Bool, Int, Float)) and isinstance(node.value, str) and not isinstance(resolve(node.text), str):
        hint = f"write it without quotes: {node.text}"
        raise InvalidValueError(node.span, Code.WRONG_TYPE, f"the text '{node.text}' is not a {kind}", hint)
    if isinstance(kind, Bool) and not isinstance(node.value, bool):
        hint = {"0": "write false", "1": "write true"}.get(node.text, "write true or false")
        raise InvalidValueError(node.span, Code.WRONG_TYPE, f"'{node.text}' is not a bool", hint)


def _near(text: str, span: SourceSpan) -> Scalar | None:
    """Parse `~1.571`, any number that rounds to it, or `1.57 +- 0.01`, any number within that tolerance."""
    if match := _ROUGHLY.fullmatch(text):
        value = _finite(match[1], "number to be near", span)
        digits = len(match[2] or "") - int(match[3] or 0)
        return Scalar(value, span, float(f"0.5e{-digits}"), text)
    if match := _WITHIN.fullmatch(text):
        value = _finite(match[1], "number to be near", span)
        tolerance = _finite(match[2], "tolerance", span)
        if tolerance < 0:
            raise InvalidValueError(span, Code.BAD_VALUE, f"the tolerance '{match[2]}' is negative")
        return Scalar(value, span, tolerance, text)
    return None


def _finite(text: str, what: str, span: SourceSpan) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InvalidValueError(span, Code.BAD_VALUE, f"'{text}' is not a {what}", "write a number, as in 1.57 +- 0.01")
    return value


def _offset(node: ScalarNode) -> int | None:
    if node.text == RECEIVED_AT:
        return None
    if node.value == 0:
        return 0
    try:
        return parse_duration(node.text)
    except ValueError as error:
        hint = f"write '{RECEIVED_AT}', or the time after the beginning of the test, for example 300ms"
        raise InvalidValueError(node.span, Code.BAD_VALUE, str(error), hint) from error


# Messages from what a test gives


def protobuf_message(message_class: type[Message], given: Fields, now: int) -> Message:
    """Return a protobuf message with these fields set; `now` is when it arrives, ns."""
    return filled(message_class(), _plain(given, now, complete=False))


def ros_values(given: Fields, now: int) -> Mapping[str, Any]:
    """Return all values of a ROS message by name; values that were not given are at their default."""
    values: Mapping[str, Any] = _plain(given, now, complete=True)
    return values


def _plain(value: FieldValue, now: int, *, complete: bool) -> Any:
    """Return a given value as `filled` takes it, with messages and maps as dicts.

    `complete`: including the defaults of fields that are not given.
    """
    match value:
        case Fields():
            given = {name: _plain(member, now, complete=complete) for name, member in value.members.items()}
            return {**default_of(value.type), **given} if complete else given
        case Elements(items=(Fields(type=MessageType(is_map_entry=True, fields=(key, member))), *_)):
            absent = {} if isinstance(member.type, MessageType) else default_of(member.type)
            empty = {"key": default_of(key.type), "value": absent}
            entries_given = (empty | _plain(entry, now, complete=False) for entry in value.items)
            return {entry["key"]: entry["value"] for entry in entries_given}
        case Elements():
            return [_plain(item, now, complete=complete) for item in value.items]
        case Time():
            seconds, nanoseconds = value.type.fields
            return dict(zip((seconds.name, nanoseconds.name), divmod(value.at(now), NS_PER_SECOND), strict=True))
        case Scalar():
            return value.value
    raise AssertionError(f"{value} cannot be given")


def _is_unset(holder: Any, field: Field, value: Any) -> bool:
    if isinstance(holder, Message) and (field.has_presence or isinstance(field.type, MessageType)):
        return not holder.HasField(field.name)
    return _is_default(field.type, value, default_of(field.type, field.default))


def _is_default(kind: Type, value: Any, default: Any) -> bool:
    if isinstance(kind, MessageType):
        return all(_is_default(field.type, getattr(value, field.name), default[field.name]) for field in kind.fields)
    if isinstance(kind, List):
        same = zip(elements(kind, value), default, strict=False)
        return len(value) == len(default) and all(_is_default(kind.element, one, other) for one, other in same)
    return _same(kind, default, value)


def _same(kind: Type, expected: Any, actual: Any) -> bool:
    if isinstance(kind, Float):
        if math.isnan(expected) or math.isnan(actual):
            return math.isnan(expected) and math.isnan(actual)
        letter = "<f" if kind.bits == 32 else "<d"
        return bool(struct.unpack(letter, struct.pack(letter, expected))[0] == actual)
    if isinstance(kind, Int):
        return int(expected) == int(actual)
    return bool(expected == actual)


def _time_of(kind: MessageType, value: Any) -> int:
    """Return a message of STAMP_TYPES in ns of the wall clock."""
    seconds, nanoseconds = (getattr(value, field.name) for field in kind.fields)
    return int(seconds * NS_PER_SECOND + nanoseconds)


# Text


def shown(kind: Type, value: Any) -> str:
    """Return a value as a test would write it, on one line; messages without the fields at their default."""
    match kind:
        case MessageType() if kind.name in STAMP_TYPES:
            return offset(_time_of(kind, value) - START)
        case MessageType():
            members = ((field, getattr(value, field.name)) for field in kind.fields)
            inner = (f"{f.name}: {shown(f.type, member)}" for f, member in members if not _is_unset(value, f, member))
            return f"{{{', '.join(inner)}}}"
        case List():
            return f"[{', '.join(shown(kind.element, item) for item in elements(kind, value))}]"
        case String():
            return repr(value)
        case _:
            return scalar_text(value, kind) or "empty"


def leaves(kind: Type, value: Any, path: Path = ()) -> Iterator[tuple[str, str]]:
    """Yield every scalar of a message by its path, `header.stamp.sec` or `points[1].x`, as text.

    A submessage that is not set has none: its type may contain itself.
    """
    if isinstance(kind, MessageType):
        for field in kind.fields:
            is_submessage = isinstance(value, Message) and isinstance(field.type, MessageType)
            if not is_submessage or value.HasField(field.name):
                yield from leaves(field.type, getattr(value, field.name), (*path, field.name))
    elif isinstance(kind, List):
        for index, element in enumerate(elements(kind, value)):
            yield from leaves(kind.element, element, (*path, index))
    else:
        yield path_text(path), shown(kind, value)


def path_text(path: Path) -> str:
    """Return a path as text: `linear_acceleration.x`, `points[1].x`."""
    return "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in path).removeprefix(".")


def offset(ns: int) -> str:
    """Return a time relative to the beginning of the test, as a test would write it; negative before the beginning."""
    return f"{'-' if ns < 0 else ''}{duration(abs(ns)) if ns else '0 ms'}"
