"""The oracle of envelopes: what protobuf says of a datagram, before senders are looked at."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass

from google.protobuf.message import DecodeError, Message
from google.protobuf.unknown_fields import UnknownFieldSet

from router.types.framing import restored
from router.types.protobuf import Envelope


@dataclass(frozen=True)
class Decision:
    """What becomes of a datagram before senders are looked at.

    `reason` is None for the payload case `number`, which may have no route. For `unknown_case` and `malformed` it is
    the number of the field to blame, or 0. `is_repaired`: counted as padded.
    """

    reason: str | None
    number: int
    is_repaired: bool


def decide(envelope: Envelope, routed: Container[int], data: bytes, most: int, repairs: bool) -> Decision:
    """What becomes of `data`, of which at most `most` bytes are taken. `routed` are the payload cases with a route."""
    if len(data) > most:
        return Decision("truncated", 0, False)
    if not data:
        return Decision("empty", 0, False)
    whole = restored(data) if repairs else data
    try:
        parsed: Message = envelope.message_class.FromString(whole)
    except DecodeError:
        number = _only_payload(envelope, routed, data)
        return Decision(None, number, False) if number else Decision("malformed", 0, False)
    is_repaired = len(whole) != len(data)
    if name := parsed.WhichOneof(envelope.oneof):
        return Decision(None, envelope.cases[name].number, is_repaired)
    fields = UnknownFieldSet(parsed)
    unknown = [fields[index].field_number for index in range(len(fields))]
    if not unknown:
        return Decision("no_payload", 0, is_repaired)
    cases = {case.number for case in envelope.cases.values()}
    mistyped = [number for number in unknown if number in cases]
    return Decision("malformed" if mistyped else "unknown_case", [*mistyped, *unknown][0], is_repaired)


def _only_payload(envelope: Envelope, routed: Container[int], data: bytes) -> int | None:
    """The payload case with a route that is the only field of an envelope, and that protobuf parses by itself.

    It may be nested one level deeper than one that protobuf parses in its envelope.
    """
    tag, at = _short_varint(data, 0)
    size, at = _short_varint(data, at)
    case = next((case for case in envelope.cases.values() if case.number << 3 | 2 == tag), None)
    if case is None or case.number not in routed or at + size != len(data):
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
