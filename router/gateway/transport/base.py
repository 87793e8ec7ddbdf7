"""What a gateway and its transports have to do with each other: frames, clients, and who hears of them.

Everything here is called in the thread of the gateways' loop. Knows no topic's meaning, format or ROS.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple, Protocol

from router.table.model import Address

HIGH_WATER = 256 * 1024
"""Bytes that wait for a client from which on nothing more is to be written to it."""

LOW_WATER = 64 * 1024
"""Bytes below which a client that was over HIGH_WATER is said to have drained."""


class Frame(NamedTuple):
    """One thing to send: a packet, or a document. `data` is what clients see, without the transport's own framing.

    `born` is when it was made, in ns of the monotonic clock. A schema belongs to `type_name`, data to `topic`.
    """

    data: bytes
    topic: str
    type_name: str
    is_schema: bool
    born: int


class Client(Protocol):
    """One receiver. Hashable; `label` names it in the log."""

    @property
    def label(self) -> str: ...

    def write(self, frames: Sequence[Frame]) -> None:
        """Takes all of them, whatever their size, and returns at once."""

    def backlog(self) -> int:
        """Bytes written that the kernel (or Zenoh) has not taken yet."""

    def close(self) -> None:
        """Ends it at once; `left` follows."""


class Ears(Protocol):
    """Who hears what happens at a transport."""

    def joined(self, client: Client) -> None: ...

    def left(self, client: Client) -> None: ...

    def drained(self, client: Client) -> None:
        """Its backlog is below LOW_WATER, after it was at HIGH_WATER or more."""

    def received(self, client: Client, data: bytes, arrived_ns: int) -> None:
        """`arrived_ns` is wall-clock time."""

    def refused(self, reason: str) -> None:
        """Something came in that is not even looked at. `reason` is one of GATEWAY_REJECT_REASONS."""

    def failed(self, client: Client | None, error: Exception, lost: int) -> None:
        """Sending or receiving failed; `lost` frames of it will not arrive."""

    def contended(self) -> None:
        """Another gateway was found that has this one's place in the network."""

    def snapshot(self) -> Sequence[Frame]:
        """Schemas and latest values, for whoever asks for them; schemas first."""


class Transport(Protocol):
    """A way to clients. `address` is the local one, None without one; `is_ready` tells whether clients can come."""

    @property
    def address(self) -> Address | None: ...

    @property
    def is_ready(self) -> bool: ...

    async def open(self) -> None:
        """Raises StartError. A local address that this machine does not have yet is waited for in the background."""

    async def close(self) -> None:
        """Ends everything; no client is left when it returns."""

    def write_all(self, clients: Iterable[Client], frames: Sequence[Frame]) -> None:
        """Writes the same to several clients of this transport, and makes its wire form only once."""
