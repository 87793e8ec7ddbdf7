"""A test file as data: what is given, what is expected, and where that is written. Names are those of a table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Union

from router.compiler import Checked
from router.engine.dispatch import Peer
from router.errors import Located, SourceSpan
from router.rehearsal.matching import MessageMatch
from router.types.model import MessageType
from router.types.protobuf import PayloadCase

Counted = Mapping[str, int]
"""How many of each reason."""


@dataclass(frozen=True, slots=True)
class Repetition:
    """How often something is given: `times`, `every` ns; `age` is how long ago it was sent, ns."""

    times: int = 1
    every: int = 0
    age: int = 0


@dataclass(frozen=True, slots=True)
class GivenDatagram:
    """`content` is a payload case with its fields, or the bytes. `pad` in bytes, 0 for none."""

    span: SourceSpan
    peer: Peer
    listener: str
    content: tuple[PayloadCase, MessageMatch] | bytes
    trim: bool
    pad: int
    repetition: Repetition


@dataclass(frozen=True, slots=True)
class GivenMessage:
    """A ROS message: its fields, or its CDR bytes."""

    span: SourceSpan
    topic: str
    type: MessageType
    content: MessageMatch | bytes
    repetition: Repetition


Given = Union[GivenDatagram, GivenMessage]


@dataclass(frozen=True, slots=True)
class Whatever:
    """Delivered, with whatever in it."""


@dataclass(frozen=True, slots=True)
class Unchanged:
    """The datagram as it was given."""


@dataclass(frozen=True, slots=True)
class Payload:
    """An envelope with this payload; None for any fields."""

    case: PayloadCase
    fields: MessageMatch | None


@dataclass(frozen=True, slots=True)
class Message:
    """A ROS message of this type."""

    type: MessageType
    fields: MessageMatch


Content = Union[Whatever, Unchanged, bytes, Payload, Message]


@dataclass(frozen=True, slots=True)
class Item:
    """One delivery that is expected. `span` is the place that expects it."""

    content: Content
    span: SourceSpan


@dataclass(frozen=True, slots=True)
class Expected:
    """All that a step does; where `anything` is true, it is not looked at.

    `sent` and `published` are by endpoint and topic, in order. `filtered` and `route` are None where
    the test does not say.
    """

    span: SourceSpan
    anything: bool = False
    sent: Mapping[str, tuple[Item, ...]] = field(default_factory=dict)
    published: Mapping[str, tuple[Item, ...]] = field(default_factory=dict)
    dropped: Mapping[str, Located[Counted]] = field(default_factory=dict)
    rejected: Located[Counted] | None = None
    filtered: Located[Counted] | None = None
    route: Located[str] | None = None


@dataclass(frozen=True, slots=True)
class Step:
    """`at` and `until` in ns after the beginning of the test, None where the step before ends."""

    span: SourceSpan
    expected: Expected
    given: Given | None = None
    at: int | None = None
    until: int | None = None
    stop: bool = False


@dataclass(frozen=True, slots=True)
class TableTest:
    name: str
    span: SourceSpan
    steps: tuple[Step, ...]


@dataclass(frozen=True, slots=True)
class TableTestFile:
    """`file` is how findings name it. `checked` is its table, which has a program."""

    path: Path
    file: str
    checked: Checked
    tests: tuple[TableTest, ...]
