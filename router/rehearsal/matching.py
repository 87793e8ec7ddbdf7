"""What a table test expects of a message, field by field, and where a message differs from it.

A message is anything with its fields as attributes: a protobuf message, or what reference_cdr.parse gives. Knows types
and places in the test file, no tables and no YAML.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Union

from router.errors import SourceSpan
from router.rehearsal.shown import elements, is_unset, offset, same_value, shown, time_of
from router.types.model import List, MessageType, Type

Path = tuple[Union[str, int], ...]


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
        if not same_value(kind, self.value, actual):
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
        found = time_of(_message(kind), actual)
        if found != self.time(moments):
            expected = offset(self.time(moments) - moments.start)
            yield Difference(path, expected, offset(found - moments.start), self.span)


@dataclass(frozen=True, slots=True)
class MessageMatch:
    """A message whose other fields are all at their default."""

    members: Mapping[str, Match]
    span: SourceSpan

    def differences(self, path: Path, kind: Type, actual: Any, moments: Moments) -> Iterator[Difference]:
        for field in _message(kind).fields:
            member = self.members.get(field.name)
            value = getattr(actual, field.name)
            here = (*path, field.name)
            if member is not None:
                yield from member.differences(here, field.type, value, moments)
            elif not is_unset(actual, field, value):
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
        for index, (item, value) in enumerate(zip(self.items, elements(kind, actual), strict=True)):
            yield from item.differences((*path, index), kind.element, value, moments)


Match = Union[AnyValue, Exactly, Near, Moment, MessageMatch, ListMatch]


def path_text(path: Path) -> str:
    """`linear_acceleration.x`, `points[1].x`."""
    return "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in path).removeprefix(".")


def _message(kind: Type) -> MessageType:
    assert isinstance(kind, MessageType)  # noqa: S101 - it was read as one
    return kind
