"""A recording sent again, datagram by datagram, when and from where it came as far as that can be had.

Knows sockets and the table's addresses, no payloads.
"""

from __future__ import annotations

import re
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

from router.errors import TransportError, UsageError, did_you_mean
from router.recording.reader import Recorded, Recording
from router.table.addresses import Address
from router.table.model import RouteTable
from router.tools import places

MOST_SOCKETS = 256

_RATE = re.compile(r"([0-9]*\.?[0-9]+)x?")


def parse_rate(text: str) -> float | None:
    """`2x`, `0.5x`; None for `max`. Raises UsageError."""
    if text == "max":
        return None
    found = _RATE.fullmatch(text)
    if found is None or not 0 < (rate := float(found[1])) <= 1e6:
        raise UsageError(f"'{text}' is no rate: 2x is twice as fast as it was recorded, 0.5x half, max without waiting")
    return rate


def on_time(recording: Recording, rate: float | None) -> Iterator[Recorded]:
    """Each datagram when it is due; None is without waiting. A clock that was set meanwhile changes nothing."""
    start, first = 0.0, None
    for found in recording.datagrams():
        if first is None:
            start, first = time.monotonic(), found.steady  # not before: opening a large recording takes its time
        if rate is not None:
            wait = start + (found.steady - first) / 1e9 / rate - time.monotonic()
            if wait > 0:
                time.sleep(wait)
        yield found


@dataclass(slots=True)
class Resent:
    """What was sent. `refused` are answers that nobody listens there.

    `elsewhere` are the senders whose address this computer does not have, with that address.
    """

    datagrams: int = 0
    refused: int = 0
    elsewhere: dict[str, str] = field(default_factory=dict)


class Replayer:
    """Sends to `to`, or where `table` has the listener; from `origin`, or from where it came.

    Where it came from is the address that `table` has for the endpoint, else the recorded one. What this computer
    cannot send from is sent from any address, and noted in `resent`.
    """

    def __init__(self, table: RouteTable | None, to: Address | None, origin: Address | None) -> None:
        self.resent = Resent()
        self._table = table
        self._to = to
        self._origin = origin
        self._sockets: dict[tuple[str, tuple[str, int], str], socket.socket] = {}

    def send(self, found: Recorded) -> None:
        """Raises UsageError for a listener that has no address, TransportError for what the network does not take."""
        key = (found.listener, found.peer, found.endpoint)
        if key not in self._sockets:
            if len(self._sockets) >= MOST_SOCKETS:
                self.close()
            self._sockets[key] = self._open(found)
        sender = self._sockets[key]
        try:
            try:
                sender.send(found.data)
            except ConnectionRefusedError:  # told of an earlier one, in place of sending this one
                self.resent.refused += 1
                sender.send(found.data)
        except OSError as error:
            raise TransportError(f"cannot send to {Address(*sender.getpeername())}: {error.strerror}") from error
        self.resent.datagrams += 1

    def close(self) -> None:
        for sender in self._sockets.values():
            if sender.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
                self.resent.refused += 1
            sender.close()
        self._sockets.clear()

    def _open(self, found: Recorded) -> socket.socket:
        to, sender = self._destination(found.listener), self._bound(found)
        try:
            sender.setblocking(True)
            sender.connect(to)
        except OSError as error:
            sender.close()
            raise TransportError(f"cannot send to {to}: {error.strerror}") from error
        return sender

    def _destination(self, listener: str) -> Address:
        if self._to is not None:
            return self._to
        listeners = self._table.listeners if self._table is not None else {}
        if listener not in listeners:
            hint = did_you_mean(listener, listeners)
            raise UsageError(f"the table has no listener '{listener}' as the recording has; {hint or 'give --to'}")
        return places.listener_address(listeners[listener])

    def _bound(self, found: Recorded) -> socket.socket:
        if self._origin is not None:
            return places.open_udp(self._origin, "--from")
        wanted = Address(*found.peer)
        if self._table is not None and found.endpoint in self._table.endpoints:
            wanted = places.origin(found.endpoint, self._table)
        for address in (wanted, wanted._replace(port=0)):
            try:
                return places.open_udp(address, found.endpoint)
            except UsageError:
                continue
        self.resent.elsewhere[found.endpoint or f"{found.peer[0]}:{found.peer[1]}"] = wanted.host
        return places.open_udp(places.ANYWHERE, "replay")
