"""The interface between a gateway and its transports: frames, clients and events.

Everything here is called in the thread of the gateways' event loop.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Sequence
from typing import NamedTuple, Protocol

HIGH_WATER = 256 * 1024
"""Bytes waiting for a client at which nothing more is written to it."""

LOW_WATER = 64 * 1024
"""Bytes waiting for a client below which it is reported as drained."""

PER_TURN = 32
"""Messages of one client, or topics, that are handled before the loop continues with other work."""


class Frame(NamedTuple):
    """One packet or document to send. `data` does not include the framing of the transport.

    A schema belongs to `type_name` (and, in packets, to `topic`), data to `topic`. `older` numbers latched messages of
    a topic backwards from the newest one, which has 0. `sent_ns` is the source timestamp of a message (wall clock).
    """

    data: bytes
    topic: str
    type_name: str
    is_schema: bool
    older: int = 0
    sent_ns: int = 0


class Client(Protocol):
    """One receiver. Hashable; `label` identifies it in the log."""

    @property
    def label(self) -> str: ...

    def write(self, frames: Sequence[Frame]) -> None:
        """Accept all frames, of any size, without blocking."""

    def backlog(self) -> int:
        """Return the number of bytes written that the kernel (or Zenoh) has not taken yet."""

    def close(self) -> None:
        """Close the connection at once; `Events.left` follows."""


class Events(Protocol):
    """Callbacks of a transport."""

    def joined(self, client: Client) -> None: ...

    def left(self, client: Client) -> None: ...

    def drained(self, client: Client) -> None:
        """The client's backlog fell below LOW_WATER. May be repeated."""

    def received(self, client: Client, data: bytes, arrived_ns: int) -> None:
        """A client sent one packet or document. `arrived_ns` is wall-clock time."""

    def refused(self, reason: str) -> None:
        """Input was discarded unread. `reason` is one of GATEWAY_REJECT_REASONS."""

    def failed(self, client: Client | None, error: Exception, lost: int) -> None:
        """Sending or receiving failed; `lost` frames will not arrive."""

    def contended(self) -> None:
        """Another gateway owns, or claims, the same place in the network."""

    def connected(self, number: int) -> None:
        """The number of connected routers and peers of the network has changed."""

    async def snapshot(self) -> Sequence[Frame]:
        """Return all schemas, latest values and latched messages. A schema precedes its data."""


def report_fault(where: str, error: Exception) -> None:
    """Report an otherwise unhandled exception: a fault of the router itself."""
    what = {"message": f"a fault in the router itself {where}", "exception": error}
    asyncio.get_running_loop().call_exception_handler(what)


class Transport(Protocol):
    """Connects a gateway to its clients."""

    async def open(self) -> None:
        """Open the sockets. A local address that this machine does not have yet is retried in the background.

        Raises StartError.
        """

    async def close(self) -> None:
        """Close the sockets; all clients have left when this returns."""

    def write_all(self, clients: Iterable[Client], frames: Sequence[Frame]) -> None:
        """Write the same frames to several clients of this transport, encoding them once."""
