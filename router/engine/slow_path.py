"""Datagrams that the fast path does not take: repaired where the listener allows it, then parsed by protobuf.

The protocol lets a sender leave out the zeros at the end of an envelope, and boards may send frames of a fixed size,
padded with zeros. Both can be undone, because a tag is never zero and the last field states its length.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from typing import Generic, TypeVar

from google.protobuf.message import DecodeError as ProtobufError
from google.protobuf.message import Message
from google.protobuf.unknown_fields import UnknownFieldSet

from router.compiler.metrics import UNKNOWN_CASE
from router.compiler.program import Program
from router.table.model import Framing

Case = TypeVar("Case")

MAX_DATAGRAM = 16 * 1024
"""The longest accepted datagram, in bytes; a longer one is rejected as `truncated`."""

VARINT, I64, LEN, I32 = 0, 1, 2, 5
"""Wire types of protobuf."""

_FIXED = {I64: 8, I32: 4}
_LONGEST_VARINT = 10


class Rejected(Exception):
    """No route takes the datagram. `reason` is one of REJECT_REASONS; the message has details, or is empty."""

    def __init__(self, reason: str, detail: str = "") -> None:
        super().__init__(detail)
        self.reason = reason


class SlowPath(Generic[Case]):
    """Parses the datagrams of one listener. `cases` are those with a route, by field number."""

    def __init__(self, program: Program, counts: list[int], listener: str, cases: Mapping[int, Case]) -> None:
        plan = next(plan for plan in program.listeners if plan.name == listener)
        self._repairs = plan.framing is Framing.ZERO_TRIMMED
        self._padded = program.counters.index("datagrams_padded", listener)
        self._counters = program.counters
        self._envelope = program.envelope
        self._ignored = program.ignored
        self._case_numbers = frozenset(case.number for case in program.envelope.cases.values())
        self._counts = counts
        self._cases = cases

    def parse(self, data: bytes) -> tuple[Case, Message]:
        """Return the payload case and the payload of any datagram. Raises Rejected."""
        if len(data) > MAX_DATAGRAM:
            raise Rejected("truncated", f"{len(data)} bytes")
        if not data:
            raise Rejected("empty")
        whole = restored(data, MAX_DATAGRAM) if self._repairs else data
        try:
            envelope = self._envelope.message_class.FromString(whole)
        except ProtobufError as error:
            raise Rejected("malformed", str(error)) from error
        if len(whole) != len(data):
            self._counts[self._padded] += 1
        return self._routed(envelope)

    def _routed(self, envelope: Message) -> tuple[Case, Message]:
        name = envelope.WhichOneof(self._envelope.oneof)
        if name is None:
            reason, detail = why_no_payload(envelope, self._case_numbers)
            if reason == "unknown_case":
                self._count_unhandled(UNKNOWN_CASE)
            raise Rejected(reason, detail)
        number = self._envelope.cases[name].number
        case = self._cases.get(number)
        if case is not None:
            return case, getattr(envelope, name)
        if number in self._ignored:
            raise Rejected("ignored", name)
        self._count_unhandled(name)
        raise Rejected("unhandled", name)

    def _count_unhandled(self, case: str) -> None:
        self._counts[self._counters.index("unhandled", case)] += 1


def why_no_payload(envelope: Message, cases: Container[int]) -> tuple[str, str]:
    """Return the reason why a parsed envelope has no payload, and the field that causes it, or "".

    `cases` are the field numbers of the payload cases: one of them among the unknown fields has the wrong wire type.
    """
    fields = UnknownFieldSet(envelope)
    numbers = [fields[index].field_number for index in range(len(fields))]
    if not numbers:
        return "no_payload", ""
    if known := [number for number in numbers if number in cases]:
        return "malformed", f"field {known[0]} is no message here"
    return "unknown_case", f"field {numbers[0]}"


def restored(data: bytes, limit: int) -> bytes:
    """Return the envelope with the trailing zeros that it had when it was encoded.

    Returns `data` itself where that is complete, or cannot be such an envelope: a cut tag or length, groups, or a field
    that would make it longer than `limit` bytes. A datagram that was cut inside its last field looks like one whose
    zeros were removed; its payload then most often has a zero for a tag, which the parser refuses.
    """
    position, size = 0, len(data)
    try:
        while position < size:
            if data[position] == 0:
                return data if data[position:].strip(b"\0") else data[:position]
            tag, position = _varint(data, position)
            wire_type = tag & 7
            if wire_type in _FIXED:
                position += _FIXED[wire_type]
            elif wire_type not in (VARINT, LEN):
                return data
            elif position == size:
                position += 1  # the value or the length was zero
            else:
                value, position = _varint(data, position)
                position += value if wire_type == LEN else 0
    except IndexError:
        return data
    return data if position > limit else data.ljust(position, b"\0")


def _varint(data: bytes, position: int) -> tuple[int, int]:
    """Return a varint and the position behind it. Raises IndexError for one that is cut or too long.

    The last byte of a varint is not zero unless it is the only one; so one that is cut lacks more than zeros.
    """
    value = 0
    for index in range(_LONGEST_VARINT):
        byte = data[position + index]
        value |= (byte & 0x7F) << (7 * index)
        if byte < 0x80:
            return value, position + index + 1
    raise IndexError
