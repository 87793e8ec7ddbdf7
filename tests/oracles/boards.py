"""Limits of boards, implemented a second time: `board.h` has to give the same answers."""

from __future__ import annotations

import math
import struct
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass

from google.protobuf.descriptor import FieldDescriptor

from router.errors import plural
from router.types.board_limits import BoardField, BoardLimits, BoardMessage
from router.types.wire import GROUP, GROUP_END, I32_SIZE, I64, I64_SIZE, LEN, VARINT, encoding_of, read_varint

TOO_LARGE, NON_FINITE, MISSING_FIELD = "too_large", "non_finite", "missing_field"


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a board cannot take a datagram: TOO_LARGE, NON_FINITE or MISSING_FIELD, and a text."""

    reason: str
    text: str


def refusal(limits: BoardLimits, datagram: bytes) -> Refusal | None:
    """Why the board cannot take this well-formed envelope; None if it can."""
    if len(datagram) > limits.longest:
        return _too_many("the envelope", len(datagram), "byte", limits.longest)
    return next(_refusals(limits, datagram, limits.fields, {}), None)


def _refusals(limits: BoardLimits, message: bytes, fields: BoardMessage, counts: dict[str, int]) -> Iterator[Refusal]:
    """`counts` are the elements of each list so far, by path, because repeated messages are merged."""
    present = set()
    for number, wire_type, value in wire_fields(message):
        field = fields.get(number)
        if field is None:
            continue
        elements = _elements(field, wire_type, value)
        if elements is not None:
            present.add(number)
        if field.most is not None and elements is not None:
            counts[field.path] = total = counts.get(field.path, 0) + len(elements)
            if total > field.most or (field.has_fixed_count and not elements):
                yield _too_many(field.path, total, "element", field.most)
        for element in elements or ():
            yield from _of_element(limits, field, element, counts)
    yield from _missing(fields, present)
    for field in fields.values():
        count = counts.get(field.path, 0)
        if field.most is not None and field.has_fixed_count and count not in (0, field.most):
            yield _too_many(field.path, count, "element", field.most)


def _missing(fields: BoardMessage, present: Container[int]) -> Iterator[Refusal]:
    """Yield the required fields that are not present. nanopb expects them in each piece of a merged message."""
    for number, field in sorted(fields.items()):
        if field.is_required and number not in present:
            yield Refusal(MISSING_FIELD, f"{field.path} is missing; the board requires it")


def _of_element(limits: BoardLimits, field: BoardField, element: bytes, counts: dict[str, int]) -> Iterator[Refusal]:
    if field.message is not None:
        yield from _refusals(limits, element, field.message, {} if field.most is not None else counts)
    elif field.longest is not None:
        if not _fits(len(element), field.longest, field.has_fixed_length):
            yield _too_many(field.path, len(element), "byte", field.longest)
    elif field.integers is not None:
        number, _ = read_varint(element, 0)
        if field.descriptor.type in (FieldDescriptor.TYPE_SINT32, FieldDescriptor.TYPE_SINT64):
            number = number >> 1 if number % 2 == 0 else -(number >> 1) - 1
        elif field.integers.signed and number >= 1 << 63:
            number -= 1 << 64
        if not field.integers.low <= number <= field.integers.high:
            bounds = f"{field.integers.low} to {field.integers.high}"
            yield Refusal(TOO_LARGE, f"{field.path} is {number}; the board takes {bounds}")
    elif field.is_float and not limits.allows_non_finite:
        [number] = struct.unpack("<d" if len(element) == I64_SIZE else "<f", element)
        if not math.isfinite(number):
            yield Refusal(NON_FINITE, f"{field.path} is {number}")


def _too_many(what: str, found: int, unit: str, bound: int) -> Refusal:
    return Refusal(TOO_LARGE, f"{what} has {plural(found, unit)}; the board takes {bound}")


def _fits(size: int, bound: int, is_fixed: bool) -> bool:
    return size in (0, bound) if is_fixed else size <= bound


def _elements(field: BoardField, wire_type: int, value: bytes) -> Sequence[bytes] | None:
    """The encoded elements of a field; None if the wire type is not the declared one."""
    own = encoding_of(field.descriptor).wire_type
    if wire_type == own:
        return [value]
    if wire_type != LEN or not field.descriptor.is_repeated:
        return None
    if own == VARINT:
        return _varints(value)
    size = I64_SIZE if own == I64 else I32_SIZE
    return [value[at : at + size] for at in range(0, len(value) - size + 1, size)]


def _varints(packed: bytes) -> list[bytes]:
    found, at = [], 0
    while at < len(packed):
        _, end = read_varint(packed, at)
        found.append(packed[at:end])
        at = end
    return found


def wire_fields(message: bytes) -> Iterator[tuple[int, int, bytes]]:
    """The fields of a well-formed message: number, wire type, and the encoded value without its size.

    Skips groups.
    """
    position, open_groups = 0, 0
    while position < len(message):
        tag, position = read_varint(message, position)
        number, wire_type, start = tag >> 3, tag & 7, position
        if wire_type == GROUP:
            open_groups += 1
            continue
        if wire_type == GROUP_END:
            open_groups -= 1
            continue
        if wire_type == VARINT:
            _, position = read_varint(message, position)
        elif wire_type == LEN:
            size, start = read_varint(message, position)
            position = start + size
        else:
            position += I64_SIZE if wire_type == I64 else I32_SIZE
        if not open_groups:
            yield number, wire_type, message[start:position]
