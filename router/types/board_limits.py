"""What a datagram for a board may hold: its firmware decodes with nanopb, into structures of a fixed size.

`boards` says how large fields may be; here a datagram is checked against that before it is sent. Not checked, though
nanopb refuses it: a field of another wire type than its own, an integer of more bits than its field, a negative number
in an enum that declares none, an unknown group.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message import DecodeError as ProtobufError
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass

from router.errors import plural
from router.types.boards import OptionsOf, why_unbounded
from router.types.descriptors import message_of
from router.types.protobuf import Envelope

TOO_LARGE, NON_FINITE = "too_large", "non_finite"
"""Those of DROP_REASONS for which a datagram is not sent to a board."""

_FLOATS = (FieldDescriptor.TYPE_FLOAT, FieldDescriptor.TYPE_DOUBLE)


@dataclass(frozen=True, slots=True)
class BoardField:
    """The bounds of a field. `path` names it from the payload case on: `arm_ctrl.name`.

    `longest` is in bytes, of a string or bytes, `most` in elements. None is no bound. With `has_fixed_length` or
    `has_fixed_count` there is exactly as much, or nothing. `message` has the fields of a message.
    """

    path: str
    descriptor: FieldDescriptor
    longest: int | None = None
    most: int | None = None
    has_fixed_length: bool = False
    has_fixed_count: bool = False
    message: BoardMessage | None = None

    @property
    def is_float(self) -> bool:
        return self.descriptor.type in _FLOATS


BoardMessage = Mapping[int, BoardField]
"""The fields of a message that are checked, by number."""


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a board cannot take a datagram: TOO_LARGE or NON_FINITE, and in words."""

    reason: str
    text: str


@dataclass(frozen=True, slots=True)
class BoardLimits:
    """What one board can take. `longest` is the size of its largest envelope in bytes."""

    envelope: Envelope
    fields: BoardMessage
    longest: int
    allows_non_finite: bool

    def refusal(self, datagram: bytes) -> Refusal | None:
        """Why the board cannot take an envelope that is well formed; None if it can."""
        if len(datagram) > self.longest:
            return Refusal(TOO_LARGE, _too_many("the envelope", len(datagram), "byte", self.longest))
        try:
            message = self.envelope.message_class.FromString(datagram)
        except ProtobufError:  # a payload may have one level more than within the envelope
            return Refusal(TOO_LARGE, "messages are nested too deeply")
        return next(self._refusals(message, self.fields), None)

    def _refusals(self, message: Message, fields: BoardMessage) -> Iterator[Refusal]:
        for descriptor, value in message.ListFields():
            field = fields.get(descriptor.number)
            if field is None:
                continue
            elements = _elements(descriptor, value)
            if field.most is not None and not _fits(len(elements), field.most, field.has_fixed_count):
                yield Refusal(TOO_LARGE, _too_many(field.path, len(elements), "element", field.most))
            for element in elements:
                yield from self._of_element(field, element)

    def _of_element(self, field: BoardField, element: Any) -> Iterator[Refusal]:
        if field.message is not None:
            yield from self._refusals(element, field.message)
        elif field.longest is not None:
            size = len(element.encode() if isinstance(element, str) else element)
            if not _fits(size, field.longest, field.has_fixed_length):
                yield Refusal(TOO_LARGE, _too_many(field.path, size, "byte", field.longest))
        elif field.is_float and not self.allows_non_finite and not math.isfinite(element):
            yield Refusal(NON_FINITE, f"{field.path} is {element}")


def _too_many(what: str, found: int, unit: str, bound: int) -> str:
    return f"{what} has {plural(found, unit)}; the board takes {bound}"


def _fits(size: int, bound: int, is_fixed: bool) -> bool:
    return size in (0, bound) if is_fixed else size <= bound


def _elements(descriptor: FieldDescriptor, value: Any) -> Sequence[Any]:
    """The values of a repeated field, the entries of a map, or the only value."""
    if not descriptor.is_repeated:
        return [value]
    if descriptor.message_type is None or not descriptor.message_type.GetOptions().map_entry:
        return list(value)
    entry = GetMessageClass(descriptor.message_type)
    return [entry(key=key, value=value[key]) for key in value]


def board_fields(
    message: Descriptor, options_of: OptionsOf, path: str = "", inside: frozenset[Descriptor] = frozenset()
) -> BoardMessage:
    """The fields of a message that have bounds, or hold floats, at any depth.

    Left out is what has no bound: no payload case with such a field may be sent to a board.
    """
    fields = {}
    for descriptor in message.fields:
        options = options_of(descriptor)
        if why_unbounded(descriptor, options):
            continue
        name = f"{path}.{descriptor.name}" if path else descriptor.name
        inner: BoardMessage | None = None
        longest: int | None = None
        if descriptor.message_type is not None:
            if descriptor.message_type in inside | {message}:
                continue
            inner = board_fields(message_of(descriptor), options_of, name, inside | {message})
        elif descriptor.type == FieldDescriptor.TYPE_STRING:
            longest = (options.string_size or 1) - 1  # without its final NUL
        elif descriptor.type == FieldDescriptor.TYPE_BYTES:
            longest = options.max_size
        field = BoardField(
            path=name,
            descriptor=descriptor,
            longest=longest,
            most=options.max_count if descriptor.is_repeated else None,
            has_fixed_length=options.fixed_length and longest is not None,
            has_fixed_count=options.fixed_count,
            message=inner,
        )
        if inner or longest is not None or field.most is not None or field.is_float:
            fields[descriptor.number] = field
    return fields
