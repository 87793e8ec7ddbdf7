"""What a datagram for a board may hold: its firmware decodes with nanopb, into structures of a fixed size.

`boards` says how large fields may be; here a datagram is checked against that before it is sent. Not checked, though
nanopb refuses it: a field of another wire type than its own, an integer of more bits than its field, a negative number
in an enum that declares none, an unknown group.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from google.protobuf.descriptor import Descriptor, FieldDescriptor

from router.errors import plural
from router.types.boards import OptionsOf, why_unbounded
from router.types.descriptors import message_of
from router.types.wire import I32_SIZE, I64, I64_SIZE, LEN, VARINT, kind_of, wire_fields

TOO_LARGE, NON_FINITE = "too_large", "non_finite"
"""Those of DROP_REASONS for which a datagram is not sent to a board."""

MOST_MESSAGES, MOST_LISTS = 65536, 4096
"""Places of messages and of lists in the envelope of a board."""

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


def places(message: BoardMessage) -> tuple[int, int]:
    """How many places of messages and of lists there are in a message, with its own."""
    below = [places(field.message) for field in message.values() if field.message is not None]
    lists = sum(field.most is not None for field in message.values())
    return 1 + sum(messages for messages, _ in below), lists + sum(lists for _, lists in below)


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a board cannot take a datagram: TOO_LARGE or NON_FINITE, and in words."""

    reason: str
    text: str


@dataclass(frozen=True, slots=True)
class BoardLimits:
    """What one board can take. `longest` is the size of its largest envelope in bytes."""

    fields: BoardMessage
    longest: int
    allows_non_finite: bool

    def refusal(self, datagram: bytes) -> Refusal | None:
        """Why the board cannot take an envelope that is well formed; None if it can."""
        if len(datagram) > self.longest:
            return _too_many("the envelope", len(datagram), "byte", self.longest)
        return next(self._refusals(datagram, self.fields, {}), None)

    def _refusals(self, message: bytes, fields: BoardMessage, counts: dict[str, int]) -> Iterator[Refusal]:
        """`counts` are the elements of each list so far, by path; a message that comes twice is merged."""
        for number, wire_type, value in wire_fields(message):
            field = fields.get(number)
            if field is None:
                continue
            elements = _elements(field, wire_type, value)
            if field.most is not None and elements is not None:
                counts[field.path] = total = counts.get(field.path, 0) + len(elements)
                if total > field.most or (field.has_fixed_count and not elements):
                    yield _too_many(field.path, total, "element", field.most)
            for element in elements or ():
                yield from self._of_element(field, element, counts)
        for field in fields.values():
            count = counts.get(field.path, 0)
            if field.most is not None and field.has_fixed_count and count not in (0, field.most):
                yield _too_many(field.path, count, "element", field.most)

    def _of_element(self, field: BoardField, element: bytes, counts: dict[str, int]) -> Iterator[Refusal]:
        if field.message is not None:
            yield from self._refusals(element, field.message, {} if field.most is not None else counts)
        elif field.longest is not None:
            if not _fits(len(element), field.longest, field.has_fixed_length):
                yield _too_many(field.path, len(element), "byte", field.longest)
        elif field.is_float and not self.allows_non_finite:
            [number] = struct.unpack("<d" if len(element) == I64_SIZE else "<f", element)
            if not math.isfinite(number):
                yield Refusal(NON_FINITE, f"{field.path} is {number}")


def _too_many(what: str, found: int, unit: str, bound: int) -> Refusal:
    return Refusal(TOO_LARGE, f"{what} has {plural(found, unit)}; the board takes {bound}")


def _fits(size: int, bound: int, is_fixed: bool) -> bool:
    return size in (0, bound) if is_fixed else size <= bound


def _elements(field: BoardField, wire_type: int, value: bytes) -> Sequence[bytes] | None:
    """The elements that a field brings, as they are encoded; None if it has another wire type than its own."""
    own = kind_of(field.descriptor).wire_type
    if wire_type == own:
        return [value]
    if wire_type != LEN or not field.descriptor.is_repeated:
        return None
    if own == VARINT:
        return [b""] * sum(byte < 0x80 for byte in value)
    size = I64_SIZE if own == I64 else I32_SIZE
    return [value[at : at + size] for at in range(0, len(value) - size + 1, size)]


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
