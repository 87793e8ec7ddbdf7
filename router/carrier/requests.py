"""Sends the requests of services natively, through the same targets and senders as all other messages."""

from __future__ import annotations

import ctypes

from router import declared as c
from router.carrier.ring import Ring
from router.carrier.threads import NativeThread
from router.compiler.refusals import DROP_REASON_NAMES


class RequestSender(NativeThread):
    """Sends requests, from one thread at a time. `deadmen` is the address of the carrier's deadmen."""

    def __init__(self, library: ctypes.CDLL, deadmen: int, counts: ctypes.Array[ctypes.c_int64], events: Ring) -> None:
        """Raises MemoryError."""
        super().__init__(library, counts, events, library.requests_counters)
        self._address = int(library.requests_open(deadmen, counts, events.address) or 0)
        if not self._address:
            raise MemoryError("requests of services cannot be sent")

    def send(self, route: ctypes.Array[c.RosRoute], message: bytes, called_at: int) -> bytes | str:
        """Send the CDR bytes of a request from a client that called at `called_at` (wall clock, ns).

        Return the datagram as it was sent, or the reason why it was not.
        """
        sent = c.SentRequest()
        arguments = self._address, route, message, len(message), called_at, ctypes.byref(sent)
        reason: int = self._library.requests_send(*arguments)
        if reason != c.REQUEST_SENT:
            return DROP_REASON_NAMES[reason]
        datagram: bytes = ctypes.string_at(ctypes.c_void_p.from_buffer(sent).value or 0, sent.size)
        return datagram

    def send_again(self, route: ctypes.Array[c.RosRoute], datagram: bytes) -> str | None:
        """Send a datagram that was sent before. Return the reason if it is lost."""
        reason: int = self._library.requests_send_again(self._address, route, datagram, len(datagram))
        return None if reason == c.REQUEST_SENT else DROP_REASON_NAMES[reason]

    def look(self) -> None:
        """Compare the clocks: call it at least every 250 ms."""
        self._library.requests_look(self._address)

    def close(self) -> None:
        """Free it, before the deadmen end."""
        with self._in_use:
            address, self._address = self._address, 0
        if address:
            self._library.requests_close(address)
