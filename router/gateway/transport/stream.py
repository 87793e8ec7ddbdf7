"""What the TCP and websocket transports of a gateway have in common: a listener, and clients that may stand still.

Knows no framing.
"""

from __future__ import annotations

import asyncio
import socket
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from time import monotonic

from router.gateway.transport.arrival import LoopClock
from router.gateway.transport.base import Client, Ears, Frame
from router.gateway.transport.binding import MOST_UNACCEPTED, Binding, listen_at
from router.gateway.transport.memory import Trimmer
from router.gateway.transport.outflow import STALLED_SECONDS, Encoded, Feeder, Outflow
from router.gateway.transport.unfinished import MOST_UNFINISHED, UNFINISHED_SECONDS, Unfinished
from router.log import FloodLog, logger
from router.table.model import Address

LOOK_SECONDS = 5.0
"""Between looks for clients that stand still."""

OVERHEAD = 1 << 20
"""Bytes beyond its own length that an unfinished message may take up."""

ACCEPTED_PER_TURN = 16
"""Connections that are accepted before other work of the loop has its turn."""


class StreamClient(ABC):
    """A Client that has an outflow. `encode` is its transport's."""

    label: str
    outflow: Outflow
    encode: Callable[[Sequence[Frame]], Encoded]

    def write(self, frames: Sequence[Frame]) -> None:
        self.outflow.push(self.encode(frames))

    def backlog(self) -> int:
        return self.outflow.backlog()

    @abstractmethod
    def close(self) -> None: ...


class StreamTransport(ABC):
    """Listens at `address`, and closes clients that stand still, or begin messages of up to `most` bytes in vain."""

    def __init__(self, address: Address, ears: Ears, max_clients: int, most: int) -> None:
        self.address: Address | None = None
        self._wanted = address
        self.ears = ears
        self.feeder = Feeder()
        self.clock = LoopClock()
        self.trimmer = Trimmer()
        self._max_clients = max_clients
        self._clients: set[StreamClient] = set()
        self._unfinished: Unfinished[StreamClient] = Unfinished(max(MOST_UNFINISHED, most + OVERHEAD))
        self._binding = Binding("tcp", address, self._bind)
        self._watching: asyncio.TimerHandle | None = None
        self.is_closing = False
        self._log = FloodLog()

    @property
    def is_ready(self) -> bool:
        return self._binding.is_ready

    async def open(self) -> None:
        await self._binding.open()
        self._watch()

    async def close(self) -> None:
        self.is_closing = True  # who was accepted in this turn of the loop is told of later
        await self._binding.close()
        if self._watching is not None:
            self._watching.cancel()
        await self._stop()
        self.clock.stop()
        self.trimmer.close()
        self._log.flush(final=True)

    def write_all(self, clients: Iterable[Client], frames: Sequence[Frame]) -> None:
        encoded = self.encode(frames)
        for client in clients:
            assert isinstance(client, StreamClient)  # noqa: S101 - they came from here
            client.outflow.push(encoded)

    @abstractmethod
    def encode(self, frames: Sequence[Frame]) -> Encoded: ...

    @abstractmethod
    async def _serve(self, listening: socket.socket) -> None: ...

    @abstractmethod
    async def _stop(self) -> None: ...

    async def _bind(self) -> None:
        listening = listen_at(self._wanted)
        try:
            await self._serve(listening)
        except BaseException:
            listening.close()
            raise
        listening.listen(MOST_UNACCEPTED)
        self.address = Address(*listening.getsockname())

    def came(self, client: StreamClient) -> bool:
        """Whether there is room for one more; if there is not, that is logged."""
        if self.is_closing:
            return False
        if len(self._clients) >= self._max_clients:
            self._log.note("full", logger.warning, "a client was turned away: there are too many", client=client.label)
            return False
        self._clients.add(client)
        self.clock.start()
        self.ears.joined(client)
        return True

    def went(self, client: StreamClient) -> None:
        """Does nothing for one that was turned away."""
        if client in self._clients:
            self._clients.remove(client)
            client.outflow.clear()
            if not self._clients:
                self.clock.stop()
            self.ears.left(client)

    def holds(self, client: StreamClient, size: int) -> None:
        """To be told whenever `client` has sent something; `size` of its bytes are no whole message yet."""
        largest = self._unfinished.holds(client, size, monotonic())
        if largest is not None:
            self.ears.refused("too_large")
            self._end_unfinished(largest, "a client was closed: too much was sent in messages that are not whole")

    def holds_nothing(self, client: StreamClient) -> None:
        """It has gone."""
        self.trimmer.freed(self._unfinished.forget(client))

    def _end_unfinished(self, client: StreamClient, what: str) -> None:
        self._log.note(what, logger.warning, what, client=client.label)
        self.trimmer.freed(MOST_UNFINISHED)  # there may be many, with little each
        client.close()

    def _watch(self) -> None:
        now = monotonic()
        for client in self._unfinished.silent(now):
            self._end_unfinished(client, f"a client was closed: it did not end a message for {UNFINISHED_SECONDS:g} s")
        for client in [each for each in self._clients if each.outflow.is_stalled(now)]:
            self._log.note(
                "stalled",
                logger.warning,
                "a client was closed: send stalled",
                client=client.label,
                seconds=STALLED_SECONDS,
                waiting=client.backlog(),
            )
            client.close()
        self._log.flush()
        self._watching = asyncio.get_running_loop().call_later(LOOK_SECONDS, self._watch)
