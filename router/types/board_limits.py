"""Limits of the datagrams for a board, by field: its firmware decodes with nanopb, into structures of a fixed size.

`boards` computes how large fields may be. The carrier checks each datagram before it is sent (`native/board.h`), the
compiler checks the payloads of deadmen.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message import Message

from router.errors import plural
from router.types.boards import OptionsOf, integers, is_list, is_required, longest, stored_type, why_unbounded
from router.types.descriptors import message_of
from router.types.model import Int

if TYPE_CHECKING:
    from router.types.protobuf import Envelope, PayloadCase

MOST_MESSAGES, MOST_LISTS = 65536, 4096
"""Maximum number of messages and of lists, nested ones included, in the envelope of a board."""

_TEXTS = (FieldDescriptor.TYPE_STRING, FieldDescriptor.TYPE_BYTES)
_FLOATS = (FieldDescriptor.TYPE_FLOAT, FieldDescriptor.TYPE_DOUBLE)


@dataclass(frozen=True, slots=True)
class BoardField:
    """The bounds of a field. `path` begins with the payload case: `arm_ctrl.name`.

    `longest` is the limit of a string or bytes in bytes, `most` the limit of a list in elements; None means no limit.
    With `has_fixed_length` or `has_fixed_count` the size is exactly the limit, or zero. `integers` are those that the
    firmware can store, None if it stores all. With `is_required`, the board refuses a message without the field.
    `message` has the fields of a message.
    """

    path: str
    descriptor: FieldDescriptor
    longest: int | None = None
    most: int | None = None
    has_fixed_length: bool = False
    has_fixed_count: bool = False
    integers: Int | None = None
    is_required: bool = False
    message: BoardMessage | None = None

    @property
    def is_float(self) -> bool:
        return self.descriptor.type in _FLOATS

    @property
    def is_checked(self) -> bool:
        """Whether the field, or one inside it, has limits."""
        limits = (self.longest, self.most, self.integers)
        return bool(self.message) or self.is_float or self.is_required or any(limit is not None for limit in limits)


BoardMessage = Mapping[int, BoardField]
"""The fields of a message that are checked, by field number."""


def places(message: BoardMessage) -> tuple[int, int]:
    """Return the number of messages and of lists in a message, itself and nested ones included."""
    below = [places(field.message) for field in message.values() if field.message is not None]
    lists = sum(field.most is not None for field in message.values())
    return 1 + sum(messages for messages, _ in below), lists + sum(lists for _, lists in below)


def scalars(message: Message, fields: BoardMessage) -> Iterator[tuple[BoardField, object]]:
    """Yield the scalars of a message with their fields, if boards have limits for them."""
    for descriptor, value in message.ListFields():
        field = fields.get(descriptor.number)
        for element in value if descriptor.is_repeated else (value,):
            if field is not None and field.message is not None:
                yield from scalars(element, field.message)
            elif field is not None:
                yield field, element


@dataclass(frozen=True, slots=True)
class BoardLimits:
    """The limits of one board. `longest` is the size of its largest envelope in bytes.

    `fields` are those of the envelope. If it holds payloads as bytes, `payloads` are theirs, as a field by the number
    of the payload case.
    """

    fields: BoardMessage
    longest: int
    allows_non_finite: bool
    payloads: Mapping[int, BoardField] = field(default_factory=dict)

    def payload(self, case: PayloadCase) -> BoardMessage:
        """Return the fields of a payload."""
        tag = case.wrapping.tag
        if not tag:
            return self.fields
        held = self.payloads.get(case.number) or self.fields.get(tag >> 3)
        return held.message or {} if held is not None else {}

    def integers(self, case: PayloadCase, path: Iterable[str]) -> Int | None:
        """Return the integers that the firmware can store in a field of a payload, None if it stores all."""
        fields, found = self.payload(case), None
        for name in path:
            found = next((each for each in fields.values() if each.descriptor.name == name), None)
            fields = found.message or {} if found is not None else {}
        return found.integers if found is not None else None

    def frame(self, number: int) -> BoardMessage:
        """Return the fields of an envelope with a payload of the case with this number, which it holds as bytes."""
        held = self.payloads[number]
        return {**self.fields, held.descriptor.number: held}

    def misfit(self, field: BoardField, value: object) -> str:
        """Return why a scalar of a payload does not fit its field; empty if it does."""
        if isinstance(value, float) and not self.allows_non_finite and not math.isfinite(value):
            return f"{field.path} is {value}"
        if isinstance(value, int) and field.integers is not None:
            low, high = field.integers.low, field.integers.high
            return "" if low <= value <= high else f"{field.path} is {value}; the board takes {low} to {high}"
        if not isinstance(value, (str, bytes)) or field.longest is None:
            return ""
        size = len(value.encode() if isinstance(value, str) else value)
        fits = size in (0, field.longest) if field.has_fixed_length else size <= field.longest
        return "" if fits else f"{field.path} has {plural(size, 'byte')}; the board takes {field.longest}"


def payload_fields(envelope: Envelope, cases: Iterable[PayloadCase], options_of: OptionsOf) -> Mapping[int, BoardField]:
    """Return the payloads that an envelope holds as bytes, as fields, by the number of the payload case."""
    descriptor: Descriptor = envelope.message_class.DESCRIPTOR  # type: ignore[assignment]  # or upb's, which is the same
    fields = {}
    for case in cases:
        holder = descriptor.fields_by_number.get(case.wrapping.tag >> 3)
        if holder is not None and holder.type == FieldDescriptor.TYPE_BYTES:
            payload: Descriptor = case.message_class.DESCRIPTOR  # type: ignore[assignment]  # likewise
            message = board_fields(payload, options_of, case.name)
            fields[case.number] = BoardField(case.name, holder, message=message)
    return fields


def board_fields(
    message: Descriptor, options_of: OptionsOf, path: str = "", inside: frozenset[Descriptor] = frozenset()
) -> BoardMessage:
    """Return the fields of a message that are required, have bounds or contain floats, at any depth.

    Nothing in an unbounded field is checked: no payload case with such a field may be sent to a board.
    """
    fields = {}
    for descriptor in message.fields:
        options = options_of(descriptor)
        if options.is_ignored:
            continue
        name = f"{path}.{descriptor.name}" if path else descriptor.name
        is_recursive = descriptor.message_type is not None and descriptor.message_type in inside | {message}
        if is_recursive or why_unbounded(descriptor, options):
            if is_required(descriptor, options):
                fields[descriptor.number] = BoardField(name, descriptor, is_required=True)
            continue
        inner: BoardMessage | None = None
        if descriptor.message_type is not None:
            inner = board_fields(message_of(descriptor), options_of, name, inside | {message})
        has_many = is_list(descriptor, options)
        field = BoardField(
            path=name,
            descriptor=descriptor,
            longest=longest(descriptor, options) if descriptor.type in _TEXTS else None,
            most=options.max_count if has_many else None,
            has_fixed_length=options.fixed_length and stored_type(descriptor, options) == FieldDescriptor.TYPE_BYTES,
            has_fixed_count=options.fixed_count and has_many,
            integers=integers(descriptor, options),
            is_required=is_required(descriptor, options),
            message=inner,
        )
        if field.is_checked:
            fields[descriptor.number] = field
    return fields
