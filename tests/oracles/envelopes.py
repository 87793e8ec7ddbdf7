"""The oracle of envelopes: protobuf's verdict on a datagram, before the sender is checked."""

from __future__ import annotations

from collections.abc import Container, Iterator
from dataclasses import dataclass
from itertools import groupby

from google.protobuf.empty_pb2 import Empty
from google.protobuf.message import DecodeError, Message
from google.protobuf.unknown_fields import UnknownFieldSet

from router.types.case_by import ByCases, ByFrame, ByName
from router.types.framing import restored
from router.types.protobuf import Envelope
from router.types.wire import LEN


@dataclass(frozen=True)
class Decision:
    """The decision about a datagram before the sender is checked.

    If `reason` is None, `number` is the payload case, which may have no route. For `unknown_case` and `malformed`,
    `number` is the offending field or 0. `is_repaired`: the datagram counts as padded. `superseded`: the number of
    payloads before the last one, pieces of one counted once.
    """

    reason: str | None
    number: int
    is_repaired: bool
    superseded: int = 0


def decide(envelope: Envelope, routed: Container[str], data: bytes, most: int, repairs: bool) -> Decision:
    """The decision about `data`, of at most `most` bytes. `routed` are the payload cases with a route."""
    if len(data) > most:
        return Decision("truncated", 0, False)
    whole = restored(data) if repairs else data
    try:
        parsed: Message = envelope.message_class.FromString(whole)
    except DecodeError:
        number = None if isinstance(envelope.choice, (ByFrame, ByName)) else _only_payload(envelope, routed, data)
        return Decision(None, number, False) if number else Decision("malformed", 0, False)
    is_repaired = len(whole) != len(data)
    if isinstance(envelope.choice, ByFrame):
        return Decision(None, envelope.numbers[envelope.choice.case], is_repaired)
    if not data:
        return Decision("empty", 0, False)
    if isinstance(envelope.choice, ByName):
        return _decide_by_name(envelope, envelope.choice, routed, parsed, whole, is_repaired)
    if isinstance(envelope.choice, ByCases):
        present = any(parsed.HasField(name) for name in envelope.cases)
    else:
        present = parsed.WhichOneof(envelope.choice.oneof) is not None
    if present:
        members = _members(envelope, whole)
        return Decision(None, members[-1], is_repaired, len(members) - 1)
    fields = UnknownFieldSet(parsed)
    unknown = [fields[index].field_number for index in range(len(fields))]
    if not unknown:
        return Decision("no_payload", 0, is_repaired)
    cases = {case.number for case in envelope.cases.values()}
    mistyped = [number for number in unknown if number in cases]
    return Decision("malformed" if mistyped else "unknown_case", [*mistyped, *unknown][0], is_repaired)


def _decide_by_name(
    envelope: Envelope, by: ByName, routed: Container[str], parsed: Message, whole: bytes, is_repaired: bool
) -> Decision:
    unknown = UnknownFieldSet(parsed)
    numbers = {unknown[index].field_number for index in range(len(unknown))}
    name, data = getattr(parsed, by.name[0]), getattr(parsed, by.data[0])
    if not name:
        is_mistyped = by.name[1] in numbers
        return Decision("malformed" if is_mistyped else "no_payload", by.name[1] if is_mistyped else 0, is_repaired)
    case = envelope.cases.get(name)
    if case is None:
        return Decision("unknown_case", 0, is_repaired)
    fields = UnknownFieldSet(Empty.FromString(whole))
    found = [(fields[index].field_number, fields[index].wire_type) for index in range(len(fields))]
    names, payloads = found.count((by.name[1], LEN)), found.count((by.data[1], LEN))
    if by.data[1] in numbers and not data:
        return Decision("malformed", by.data[1], is_repaired)
    try:
        if case.name in routed:
            case.message_class.FromString(data)
    except DecodeError:
        return Decision("malformed", 0, is_repaired)
    return Decision(None, case.number, is_repaired, max(names, payloads) - 1)


def parts(envelope: Envelope, whole: bytes) -> list[tuple[int, bytes]]:
    """Number and frame of each message that a frame holds, in order, of an envelope by cases."""
    fields = [*_fields(whole)]
    cases = {case.number for case in envelope.cases.values()}
    held = sorted({number for number, wire_type, _ in fields if number in cases and wire_type == LEN})
    frames = {
        kept: b"".join(data for number, kind, data in fields if number not in cases or kind != LEN or number == kept)
        for kept in held
    }
    for kept, frame in frames.items():
        expected = envelope.message_class.FromString(whole)
        for case in envelope.cases.values():
            if case.number != kept:
                expected.ClearField(case.name)
        found = envelope.message_class.FromString(frame)
        assert found.SerializePartialToString() == expected.SerializePartialToString()
    return [*frames.items()]


def _fields(whole: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Number, wire type and encoding of each field: what protobuf makes of ever more bytes says where a field ends."""
    begin = 0
    for end in range(1, len(whole) + 1):
        try:
            fields = UnknownFieldSet(Empty.FromString(whole[begin:end]))
        except DecodeError:
            continue
        yield fields[0].field_number, fields[0].wire_type, whole[begin:end]
        begin = end


def _members(envelope: Envelope, whole: bytes) -> list[int]:
    """The payloads in a frame by number, pieces of one counted once."""
    members = {(case.number, LEN) for case in envelope.cases.values()}
    members |= {(member.number, member.wire_type) for member in envelope.unroutable.values()}
    fields = UnknownFieldSet(Empty.FromString(whole))
    found = [(fields[index].field_number, fields[index].wire_type) for index in range(len(fields))]
    payloads = [member for member in found if member in members]
    return [number for (number, _), _ in groupby(payloads)]


def _only_payload(envelope: Envelope, routed: Container[str], data: bytes) -> int | None:
    """The routed payload case that is an envelope's only field and that protobuf parses separately.

    Its nesting may be one level deeper than protobuf allows within an envelope.
    """
    tag, at = _short_varint(data, 0)
    size, at = _short_varint(data, at)
    case = next((case for case in envelope.cases.values() if case.number << 3 | 2 == tag), None)
    if case is None or case.name not in routed or at + size != len(data):
        return None
    try:
        case.message_class.FromString(data[at:])
    except DecodeError:
        return None
    return case.number


def _short_varint(data: bytes, at: int) -> tuple[int, int]:
    """A number of one or two bytes, and where it ends; -1 for anything else."""
    first, second = (*data[at : at + 2], 0x80, 0x80)[:2]
    if first < 0x80:
        return first, at + 1
    return (first & 0x7F | second << 7, at + 2) if second < 0x80 else (-1, at)
