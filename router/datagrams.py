"""Builds and parses single datagrams, for tools and log messages. Routes do not use this module."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from google.protobuf.message import DecodeError as ProtobufError
from google.protobuf.message import Message
from google.protobuf.unknown_fields import UnknownFieldSet

from router.declared import MAX_DATAGRAM
from router.errors import DecodeError, Located, SourceSpan, UsageError, shown_path
from router.table.model import RouteTable
from router.table.model.settings import EnvelopeSettings
from router.types.envelopes import chosen_envelope
from router.types.framing import restored
from router.types.lock_file import ENVELOPE, ONEOF
from router.types.model import MessageType
from router.types.protobuf import Envelope, MessageClass, PayloadCase, find_envelope, load_protos
from router.types.table_envelopes import Envelopes, told_apart
from router.types.wire import read_varint

Peer = tuple[str, int]
"""The IP address and port of a sender."""

_NO_FIELDS = MessageType("")


@dataclass(frozen=True, slots=True)
class Decoded:
    """A payload and its case. `zeros` is the number of trailing zeros restored, or removed if negative.

    `superseded` has the cases of other payloads before it. `beside` is the envelope without the payload, None if that
    has no other fields, and `beside_type` its type.
    """

    case: PayloadCase
    message: Message
    zeros: int
    superseded: Sequence[str] = ()
    beside: Message | None = None
    beside_type: MessageType = _NO_FIELDS


@dataclass(frozen=True, slots=True)
class Wire:
    """The wire format of envelopes and their payload cases."""

    envelopes: Envelopes

    def case(self, name: str) -> PayloadCase:
        """Return a payload case. Raises UsageError if it does not exist."""
        if name not in self.envelopes.cases:
            raise UsageError(*self.envelopes.unknown_case(name))
        return self.envelopes.cases[name]

    def encode(self, case: PayloadCase, payload: Message, beside: Message | None = None) -> bytes:
        """Return the exact encoding of an envelope with this payload, and with the other fields of `beside`.

        Raises UsageError if the payload lacks a required field.
        """
        return self.encode_all([(case, payload)], beside)

    def encode_all(self, payloads: Sequence[tuple[PayloadCase, Message]], beside: Message | None = None) -> bytes:
        """Like `encode`, with one payload or several. Raises UsageError also if the envelope cannot hold them."""
        (first, inside), *others = payloads
        envelope = self.envelopes.of(first.name)
        if others and not all(case.wrapping.is_shared and case.name in envelope.cases for case, _ in payloads):
            raise UsageError(f"{envelope.name} cannot hold {' and '.join(case.name for case, _ in payloads)} at once")
        for case, payload in payloads:
            if not payload.IsInitialized():
                fields = " and ".join(payload.FindInitializationErrors())  # type: ignore[attr-defined]  # all have it
                raise UsageError(f"{case.type.name} requires {fields}", f"give {fields} a value")
        frame = envelope.around(first, inside, beside)
        for case, payload in others:
            envelope.choice.put(frame, case, payload)
        return frame.SerializePartialToString()

    def decode(self, datagram: bytes, envelope: Envelope | None = None) -> Decoded:
        """Parse a datagram as a listener with `framing: zero_trimmed` does; `envelope` is the only one by default.

        Of one with several messages, return the first. Raises DecodeError, which begins with the reason under which
        the router counts such a datagram.
        """
        return self.decode_all(datagram, envelope)[0]

    def decode_all(self, datagram: bytes, envelope: Envelope | None = None) -> list[Decoded]:
        """Like `decode`, but return all messages of the datagram."""
        if len(datagram) > MAX_DATAGRAM:
            raise DecodeError(f"truncated: {len(datagram)} bytes; the limit is {MAX_DATAGRAM}")
        whole, envelope = restored(datagram), envelope or self.envelopes.first
        try:
            outer = envelope.message_class.FromString(whole)
        except ProtobufError as error:
            raise DecodeError(f"malformed: {_why_malformed(envelope, datagram)}") from error
        if not (members := envelope.members_of(outer)):
            reason, detail = _why_no_payload(envelope, outer, datagram)
            raise DecodeError(f"{reason}: {detail}" if detail else reason)
        if (other := envelope.unroutable.get(members[0])) is not None:
            raise DecodeError(f"unhandled: {members[0]} is {other.type}, not a message")
        try:
            found = envelope.payloads_of(outer)
        except ProtobufError as error:
            raise DecodeError(f"malformed: {_unparsed(members[0])}") from error
        superseded = payloads(envelope, whole, repairs=False)[:-1] if len(found) == 1 else ()
        kind = envelope.beside
        beside = envelope.beside_of(outer) if kind.fields else None
        zeros = len(whole) - len(datagram)
        return [Decoded(case, message, zeros, superseded, beside, kind) for case, message in found]


def wire_of_table(table: RouteTable) -> Wire:
    """Return the envelopes of the table. Raises TableError, and UsageError if the table has none."""
    if not table.envelopes:
        raise UsageError(f"{shown_path(table.path)} has no 'envelope', so there are no datagrams to build or parse")

    def chosen(settings: EnvelopeSettings) -> Envelope:
        schema = load_protos(
            settings.protos, settings.message, settings.lock_file, settings.exclude, with_others=settings.has_many
        )
        return chosen_envelope(schema, settings.choice)

    by_name = {name: chosen(settings) for name, settings in table.envelopes.items()}
    return Wire(Envelopes(told_apart(by_name), *table.envelope_names))


def wire_of_protos(root: Path) -> Wire:
    """Return the envelope `PBEnvelope.payload` of a folder of `.proto` files. Raises TableError."""
    span = SourceSpan(shown_path(root))
    schema = load_protos(Located(root, span), Located(ENVELOPE, span))
    return Wire(Envelopes({"": find_envelope(schema, Located(ONEOF, span))}))


def framed(exact: bytes, trim: bool, pad: int) -> bytes:
    """Return a datagram as boards may send it: without trailing zeros, then padded with zeros to `pad` bytes.

    Raises UsageError if it is longer than `pad`.
    """
    sent = exact.rstrip(b"\0") if trim else exact
    if pad and len(sent) > pad:
        raise UsageError(f"the datagram has {len(sent)} bytes and cannot be padded to {pad}")
    return sent.ljust(pad, b"\0")


def why_rejected(envelope: Envelope, data: bytes, length: int, *, repairs: bool) -> str:
    """Describe what is wrong with a datagram of `length` bytes; `data` may be only its beginning.

    `repairs`: the listener restores zeros. For a datagram with a payload, return its case: no route accepts it.
    """
    if length > MAX_DATAGRAM:
        return f"{length} bytes"
    whole = data if len(data) == length else b""
    try:
        outer = envelope.message_class.FromString(restored(data) if repairs else data)
    except ProtobufError:
        return _why_malformed(envelope, whole)
    if not (members := envelope.members_of(outer)):
        return _why_no_payload(envelope, outer, whole)[1]
    try:
        envelope.payloads_of(outer)
    except ProtobufError:
        return _unparsed(members[0])
    return ", ".join(members)


def payloads(envelope: Envelope, data: bytes, *, repairs: bool) -> list[str]:
    """Return the payload cases in a datagram in order, also superseded ones; consecutive pieces are one.

    Raises protobuf's DecodeError.
    """
    return [*envelope.choice.all_members(envelope, restored(data) if repairs else data)]


def _why_no_payload(envelope: Envelope, outer: Message, datagram: bytes) -> tuple[str, str]:
    """Return the reason why a parsed envelope has no payload, and the field or name that causes it, or ""."""
    reason, detail = envelope.choice.why_none(envelope, outer)
    if reason == "malformed":
        return reason, _why_malformed(envelope, datagram, detail)
    return ("empty", "") if not datagram else (reason, detail)


def _unparsed(case: str) -> str:
    return f"the payload is not a valid {case}"


def _why_malformed(envelope: Envelope, datagram: bytes, what: str = "") -> str:
    """Describe what is wrong, and its likely cause: firmware that frames an envelope, or sends none."""
    cause = _framing(envelope, datagram) or _bare_payload(envelope, datagram)
    return "; ".join(filter(None, (what or f"does not parse as {envelope.name}", cause)))


_CHECKSUMS = (1, 2, 4)
"""Sizes in bytes of checksums that serial protocols append to a message."""


def _framing(envelope: Envelope, datagram: bytes) -> str:
    """Describe a length or a checksum around a complete envelope; empty if there is none."""
    for size, length in _lengths(datagram):
        if length == len(datagram) - size and _has_payload(envelope, datagram[size:]):
            return f"a length ({_bytes(size)}) precedes the envelope: send the envelope alone"
    for size in _CHECKSUMS:
        if _has_payload(envelope, datagram[:-size]):
            return f"{_bytes(size)} after the envelope look like a checksum: send the envelope alone"
    return ""


def _lengths(datagram: bytes) -> Iterator[tuple[int, int]]:
    """Yield the lengths that a datagram may begin with, each as (bytes that it occupies, value)."""
    try:
        length, size = read_varint(datagram, 0)
    except IndexError:
        return
    yield size, length
    for size in (1, 2, 4):
        for order in ("little", "big"):
            yield size, int.from_bytes(datagram[:size], order)


def _has_payload(envelope: Envelope, data: bytes) -> bool:
    outer = _parsed(envelope.message_class, data)
    return outer is not None and bool(envelope.members_of(outer))


def _bare_payload(envelope: Envelope, datagram: bytes) -> str:
    """Name the payload cases that a datagram without an envelope may be; empty if there are none."""
    cases = [case.name for case in envelope.cases.values() if _parsed(case.message_class, datagram)]
    if not cases:
        return ""
    names = " or ".join(f"'{name}'" for name in cases) if len(cases) <= _MOST_NAMED else "one of several cases"
    return f"it may be the payload {names} without its envelope"


_MOST_NAMED = 3


def _parsed(message_class: MessageClass, data: bytes) -> Message | None:
    """Parse a message; None unless it has fields and all of them are known."""
    try:
        message = message_class.FromString(data)
    except ProtobufError:
        return None
    return message if message.ListFields() and not len(UnknownFieldSet(message)) else None


def _bytes(size: int) -> str:
    return "1 byte" if size == 1 else f"{size} bytes"
