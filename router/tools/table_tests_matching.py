"""What a table test expects of a message, field by field, and where a message differs from it.

A message is anything with its fields as attributes: a protobuf message, or what reference_cdr.parse gives. Knows types
and places in the test file, no tables and no YAML.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Union

from google.protobuf.message import Message

from router.compiler.implementations import NS_PER_SECOND
from router.errors import SourceSpan
from router.tools.rehearsal import START
from router.tools.show import float_text
from router.types.model import Bool, Bytes, Enum, Field, Float, Int, List, MessageType, String, Type

Path = tuple[Union[str, int], ...]
TIMES = frozenset({"builtin_interfaces/msg/Time", "google.protobuf.Timestamp"})


@dataclass(frozen=True, slots=True)
class Difference:
    """One field that is not what was expected; `span` is the place that expects it."""

    path: Path
    expected: str
    actual: str
    span: SourceSpan

    def __str__(self) -> str:
        return f"{path_text(self.path)} is {self.actual}, not {self.expected}"


@dataclass(frozen=True, slots=True)
class Moments:
    """The times of one run, ns: `start` of the test, and `now`, when the step's message came in."""

    start: int
    now: int


@dataclass(frozen=True, slots=True)
class AnyValue:
    span: SourceSpan

    def differences(self, path: Path, kind: Type, actual: Any, moments: Moments) -> Iterator[Difference]:
        """None."""
        yield from ()


@dataclass(frozen=True, slots=True)
class Exactly:
    """A scalar; of a float32 the nearest one to what is written."""

    value: Any
    span: SourceSpan

    def differences(self, path: Path, kind: Type, actual: Any, moments: Moments) -> Iterator[Difference]:
        if not _same(kind, self.value, actual):
            yield Difference(path, shown(kind, self.value), shown(kind, actual), self.span)


@dataclass(frozen=True, slots=True)
class Near:
    """A number that may be `tolerance` off; `text` is how that was written."""

    value: float
    tolerance: float
    text: str
    span: SourceSpan

    def differences(self, path: Path, kind: Type, actual: Any, moments: Moments) -> Iterator[Difference]:
        slack = 4 * math.ulp(self.value)  # the ends of the interval are written in decimal
        if not abs(actual - self.value) <= self.tolerance + slack:
            yield Difference(path, self.text, shown(kind, actual), self.span)


@dataclass(frozen=True, slots=True)
class Moment:
    """A time: `offset` ns after the test's start, or None for when the message came in."""

    offset: int | None
    span: SourceSpan

    def time(self, moments: Moments) -> int:
        return moments.now if self.offset is None else moments.start + self.offset

    def differences(self, path: Path, kind: Type, actual: Any, moments: Moments) -> Iterator[Difference]:
        found = _time(kind, actual)
        if found != self.time(moments):
            expected = self.time(moments) - moments.start
            yield Difference(path, f"{expected / 1e6:g} ms", f"{(found - moments.start) / 1e6:g} ms", self.span)


@dataclass(frozen=True, slots=True)
class MessageMatch:
    """A message whose other fields are all at their default."""

    members: Mapping[str, Match]
    span: SourceSpan

    def differences(self, path: Path, kind: Type, actual: Any, moments: Moments) -> Iterator[Difference]:
        for field in _fields(kind):
            member = self.members.get(field.name)
            value = getattr(actual, field.name)
            here = (*path, field.name)
            if member is not None:
                yield from member.differences(here, field.type, value, moments)
            elif not _is_unset(actual, field, value):
                yield Difference(here, "at its default", shown(field.type, value), self.span)


@dataclass(frozen=True, slots=True)
class ListMatch:
    items: tuple[Match, ...]
    span: SourceSpan

    def differences(self, path: Path, kind: Type, actual: Any, moments: Moments) -> Iterator[Difference]:
        assert isinstance(kind, List)  # noqa: S101 - it was read as one
        if len(actual) != len(self.items):
            found = f"{len(actual)} elements {shown(kind, actual)}" if len(actual) else "empty"
            yield Difference(path, f"{len(self.items)} elements", found, self.span)
            return
        for index, (item, value) in enumerate(zip(self.items, actual, strict=True)):
            yield from item.differences((*path, index), kind.element, value, moments)


Match = Union[AnyValue, Exactly, Near, Moment, MessageMatch, ListMatch]


def path_text(path: Path) -> str:
    """`linear_acceleration.x`, `points[1].x`."""
    return "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in path).removeprefix(".")


def shown(kind: Type, value: Any) -> str:
    """A value as a test would write it, on one line."""
    match kind:
        case MessageType() if kind.name in TIMES:
            return f"{(_time(kind, value) - START) / 1e6:g} ms"
        case MessageType():
            inner = ", ".join(words(kind, value))
            return f"{{{inner}}}"
        case List():
            return f"[{', '.join(shown(kind.element, item) for item in value)}]"
        case Enum():
            return next((name for name, number in kind.values if number == value), str(value))
        case Float():
            return float_text(float(value), kind.bits)
        case Bool():
            return "true" if value else "false"
        case Bytes():
            return bytes(value).hex() or "empty"
        case String():
            return repr(value)
        case _:
            return str(value)


def words(kind: MessageType, value: Any) -> Iterator[str]:
    """`name: value` of every field that is not at its default."""
    for field in kind.fields:
        member = getattr(value, field.name)
        if not _is_unset(value, field, member):
            yield f"{field.name}: {shown(field.type, member)}"


def default_of(kind: Type, default: object = None) -> Any:
    """What a field holds that nobody filled; of a message the values by name. `default` is the declared one."""
    if default is not None:
        return default
    match kind:
        case MessageType():
            return {field.name: default_of(field.type, field.default) for field in kind.fields}
        case List():
            return [default_of(kind.element) for _ in range(kind.length or 0)]
        case String():
            return ""
        case Bytes():
            return b""
        case Float():
            return 0.0
        case Bool():
            return False
        case _:
            return 0


def _is_unset(holder: Any, field: Field, value: Any) -> bool:
    if isinstance(holder, Message) and (field.has_presence or isinstance(field.type, MessageType)):
        return not holder.HasField(field.name)
    return _is_default(field.type, value, default_of(field.type, field.default))


def _is_default(kind: Type, value: Any, default: Any) -> bool:
    if isinstance(kind, MessageType):
        return all(_is_default(field.type, getattr(value, field.name), default[field.name]) for field in kind.fields)
    if isinstance(kind, List):
        same = zip(value, default, strict=False)
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


def _time(kind: Type, value: Any) -> int:
    """A message of TIMES in ns."""
    seconds, nanoseconds = (getattr(value, field.name) for field in _fields(kind))
    return int(seconds * NS_PER_SECOND + nanoseconds)


def _fields(kind: Type) -> tuple[Field, ...]:
    assert isinstance(kind, MessageType)  # noqa: S101 - it was read as one
    return kind.fields
