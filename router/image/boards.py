"""The limits of boards, as arrays for `board_takes`."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from typing import Union

from google.protobuf.descriptor import FieldDescriptor

from router import declared as c
from router.compiler.lowering.arrays import Arrays
from router.declared import BoardFlag, WireKind
from router.image.wire_schema import wire_kind
from router.types.board_limits import BoardField, BoardLimits, BoardMessage
from router.types.wire import LEN, encoding_of

_MOST_REQUIRED = 64
"""Required fields of a message that are checked: those that nanopb checks, unless the firmware sets another number."""

_UNBOUNDED = (1 << 32) - 1
_ZIGZAG = (FieldDescriptor.TYPE_SINT32, FieldDescriptor.TYPE_SINT64)


Boards = Mapping[Union[str, tuple[str, int]], "ctypes._Pointer[c.Board]"]
"""By endpoint; for payloads that the envelope holds as bytes, by endpoint and the number of the payload case."""


def write_boards(boards: Mapping[str, BoardLimits], arrays: Arrays) -> Boards:
    """Make a `struct board` for each endpoint that is a board. Boards with the same firmware share its fields."""
    trees: dict[tuple[int, int], _Tree] = {}
    made: dict[str | tuple[str, int], ctypes._Pointer[c.Board]] = {}
    for name, limits in boards.items():
        for number in (0, *limits.payloads):
            key = id(limits.fields), number
            if key not in trees:
                trees[key] = _Tree(limits.frame(number) if number else limits.fields, arrays)
            board = c.Board(
                messages=trees[key].messages, longest=limits.longest, allows_non_finite=limits.allows_non_finite
            )
            made[(name, number) if number else name] = ctypes.pointer(arrays.add(board))
    return made


class _Tree:
    """The flattened message tree of an envelope: each message in it has an index and a range of counters."""

    def __init__(self, envelope: BoardMessage, arrays: Arrays) -> None:
        self._messages: list[c.BoardMessage] = []
        self._arrays = arrays
        self._counters = 0
        self._add(envelope)
        self.messages = arrays.array(c.BoardMessage, self._messages)

    def _add(self, message: BoardMessage) -> int:
        index, first = len(self._messages), self._counters
        self._messages.append(c.BoardMessage())
        ordered = sorted(message.items())
        counters = {number: self._counter() for number, field in ordered if field.most is not None}
        required = [number for number, field in ordered if field.is_required][:_MOST_REQUIRED]
        bits = {number: 1 << place for place, number in enumerate(required)}
        fields = [self._field(number, field, counters.get(number, 0), bits.get(number, 0)) for number, field in ordered]
        array = self._arrays.array(c.BoardField, fields)
        self._messages[index] = c.BoardMessage(
            fields=array,
            count=len(fields),
            first_counter=first,
            counter_count=self._counters - first,
            required=sum(bits.values()),
        )
        return index

    def _counter(self) -> int:
        self._counters += 1
        return self._counters - 1

    def _field(self, number: int, field: BoardField, counter: int, required: int) -> c.BoardField:
        flags = 0
        if field.is_float:
            flags |= BoardFlag.IS_FLOAT
        if field.most is not None:
            flags |= BoardFlag.IS_REPEATED
        if field.has_fixed_length:
            flags |= BoardFlag.HAS_FIXED_LENGTH
        if field.has_fixed_count:
            flags |= BoardFlag.HAS_FIXED_COUNT
        if field.integers is not None:
            flags |= BoardFlag.HAS_RANGE
        if field.descriptor.type in _ZIGZAG:
            flags |= BoardFlag.IS_ZIGZAG
        return c.BoardField(
            number=number,
            kind=_kind(field),
            flags=flags,
            message=self._add(field.message) if field.message is not None else 0,
            longest=field.longest if field.longest is not None else _UNBOUNDED,
            most=field.most or 0,
            counter=counter,
            wire_types=_wire_types(field),
            low=field.integers.low if field.integers is not None else 0,
            high=field.integers.high if field.integers is not None else 0,
            required=required,
            path=self._arrays.text(field.path.encode()),
        )


def _wire_types(field: BoardField) -> int:
    own = 1 << encoding_of(field.descriptor).wire_type
    return own | 1 << LEN if field.most is not None else own


def _kind(field: BoardField) -> WireKind:
    kind = wire_kind(field.descriptor)
    if field.message is not None and kind is WireKind.BYTES:
        return WireKind.MESSAGE  # a payload
    is_opaque = kind is WireKind.STRING or (kind is WireKind.MESSAGE and field.message is None)
    return WireKind.BYTES if is_opaque else kind
