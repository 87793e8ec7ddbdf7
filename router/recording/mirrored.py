"""What a datagram that the mirror shows is to a table: which payload is in it, and who sent it.

The one place that says so beside routing, and it says what the router does. Knows nobody who is shown it.
"""

from __future__ import annotations

from google.protobuf.message import DecodeError as ProtobufError
from google.protobuf.message import Message

from router.compiler.network import recognisers
from router.engine import MAX_DATAGRAM
from router.engine.framing import restored
from router.table.model import Framing, RouteTable
from router.types.protobuf import Envelope, PayloadCase

_NOBODY: tuple[dict[str, str], dict[tuple[str, int], str]] = {}, {}


class Known:
    """What one table knows of payloads, listeners and senders. Any thread may ask."""

    def __init__(self, envelope: Envelope, table: RouteTable) -> None:
        self.envelope = envelope
        self._repairing = frozenset(
            listener.name for listener in table.listeners.values() if listener.framing is Framing.ZERO_TRIMMED
        )
        self._recognisers = {name: recognisers(table.endpoints, name) for name in table.listeners}

    def payload(self, listener: str, data: bytes) -> tuple[PayloadCase, Message] | None:
        """None for a datagram that this listener's would reject, because there is none in it."""
        if len(data) > MAX_DATAGRAM or not self.envelope.cases:
            return None
        if listener in self._repairing:
            data = restored(data, MAX_DATAGRAM)
        try:
            envelope = self.envelope.message_class.FromString(data)
        except ProtobufError:
            return None
        case = envelope.WhichOneof(self.envelope.oneof)
        return (self.envelope.cases[case], getattr(envelope, case)) if case else None

    def sender(self, listener: str, peer: tuple[str, int]) -> str:
        """What the table calls who sent something to this listener; empty for a stranger."""
        by_host, by_address = self._recognisers.get(listener, _NOBODY)
        return by_address.get(peer) or by_host.get(peer[0]) or ""


def first_field(data: bytes) -> int:
    """The number of the field that a message begins with, of those below 2048; 0 where there is none.

    Most often that is the payload's, and much sooner said than `Known.payload`.
    """
    if not data:
        return 0
    if data[0] < 0x80:
        return data[0] >> 3
    return (data[0] & 0x7F | data[1] << 7) >> 3 if len(data) > 1 and data[1] < 0x80 else 0
