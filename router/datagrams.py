"""Datagrams built from payloads and taken apart, one by one: for tools and messages, not for the running routes."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass
from pathlib import Path

from google.protobuf.message import DecodeError as ProtobufError
from google.protobuf.message import Message
from google.protobuf.unknown_fields import UnknownFieldSet

from router.declared import MAX_DATAGRAM
from router.errors import DecodeError, Located, SourceSpan, UsageError, did_you_mean, shown_path
from router.table.model import RouteTable
from router.types.framing import restored
from router.types.lock_file import ENVELOPE, ONEOF
from router.types.protobuf import Envelope, PayloadCase, find_envelope, load_protos

Peer = tuple[str, int]
"""The IP address and port of a sender."""


@dataclass(frozen=True, slots=True)
class Decoded:
    """A payload and its case. `zeros` were put back at the end of the datagram; negative: taken off."""

    case: PayloadCase
    message: Message
    zeros: int


@dataclass(frozen=True, slots=True)
class Wire:
    """The wire format of an envelope and its payload cases."""

    envelope: Envelope

    def case(self, name: str) -> PayloadCase:
        """Raises UsageError for a payload case that does not exist."""
        if name not in self.envelope.cases:
            hint = did_you_mean(name, self.envelope.cases)
            raise UsageError(f"{self.envelope.name} has no payload case '{name}'", hint)
        return self.envelope.cases[name]

    def encode(self, case: PayloadCase, payload: Message) -> bytes:
        """The exact encoding of an envelope that holds this payload."""
        outer = self.envelope.message_class()
        inner = getattr(outer, case.name)
        inner.SetInParent()
        inner.CopyFrom(payload)
        return outer.SerializeToString()

    def decode(self, datagram: bytes) -> Decoded:
        """Take a datagram apart as a listener with `framing: zero_trimmed` does.

        Raises DecodeError, which begins with the reason that the router counts such a datagram under.
        """
        if not datagram:
            raise DecodeError("empty")
        if len(datagram) > MAX_DATAGRAM:
            raise DecodeError(f"truncated: {len(datagram)} bytes, the router takes {MAX_DATAGRAM}")
        whole = restored(datagram)
        try:
            outer = self.envelope.message_class.FromString(whole)
        except ProtobufError as error:
            raise DecodeError(f"malformed: no {self.envelope.name}") from error
        name = outer.WhichOneof(self.envelope.oneof)
        if name is None:
            reason, detail = why_no_payload(outer, {case.number for case in self.envelope.cases.values()})
            raise DecodeError(f"{reason}: {detail}" if detail else reason)
        return Decoded(self.envelope.cases[name], getattr(outer, name), len(whole) - len(datagram))


def wire_of_table(table: RouteTable) -> Wire:
    """The envelope that the table names. Raises TableError, and UsageError where it names none."""
    if table.envelope is None:
        raise UsageError(f"{shown_path(table.path)} has no 'envelope': there are no datagrams to build or to read")
    settings = table.envelope
    return Wire(
        find_envelope(load_protos(settings.protos, settings.message, settings.lock, settings.exclude), settings.oneof)
    )


def wire_of_protos(root: Path) -> Wire:
    """The envelope `PBEnvelope.payload` of a folder of `.proto` files. Raises TableError."""
    span = SourceSpan(shown_path(root))
    schema = load_protos(Located(root, span), Located(ENVELOPE, span))
    return Wire(find_envelope(schema, Located(ONEOF, span)))


def framed(exact: bytes, trim: bool, pad: int) -> bytes:
    """A datagram as boards may send it: without its trailing zeros, then filled with zeros up to `pad` bytes.

    Raises UsageError for one that is longer than `pad`.
    """
    sent = exact.rstrip(b"\0") if trim else exact
    if pad and len(sent) > pad:
        raise UsageError(f"the datagram has {len(sent)} bytes and cannot be padded to {pad}")
    return sent.ljust(pad, b"\0")


def why_rejected(envelope: Envelope, data: bytes, length: int, *, repairs: bool) -> str:
    """Say in words what is wrong with a datagram of `length` bytes, of which `data` may be the beginning.

    `repairs`: the listener puts back zeros. Of a datagram with a payload, return its case: no route takes that.
    """
    if length > MAX_DATAGRAM:
        return f"{length} bytes"
    if not data:
        return ""
    try:
        outer = envelope.message_class.FromString(restored(data) if repairs else data)
    except ProtobufError as error:
        return str(error)
    name = outer.WhichOneof(envelope.oneof)
    if name is not None:
        return str(name)
    return why_no_payload(outer, {case.number for case in envelope.cases.values()})[1]


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
