"""The clients of one gateway: who gets a frame at once, who later, and what goes out between other frames."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from itertools import count

from router.gateway.encoding import LARGE, Encoding
from router.gateway.history import History
from router.gateway.ledger import Ledger
from router.gateway.subscriber import Subscriber
from router.gateway.tasks import Tasks
from router.gateway.transport.base import Client, Frame, Transport
from router.log import FloodLog, logger

PUMPED, PUMP_S = 32, 0.001
"""Datagrams of a large frame that go out at a time, and the seconds between: other topics pass between them."""


class Audience:
    """Clocks: `clock_ns` is monotonic, `wall_s` gives the wall clock in seconds."""

    def __init__(
        self,
        gateway: str,
        encoding: Encoding,
        ledger: Ledger,
        tasks: Tasks,
        clock_ns: Callable[[], int],
        wall_s: Callable[[], float],
    ) -> None:
        self.subscribers: dict[Client, Subscriber] = {}
        self._gateway = gateway
        self._encoding = encoding
        self._ledger = ledger
        self._tasks = tasks
        self._clock_ns = clock_ns
        self._wall_s = wall_s
        self._history = History()
        self._log = FloodLog()
        self._large: dict[str, Frame] = {}  # by topic
        self._is_pumping = False

    def __bool__(self) -> bool:
        """Whether there is anybody."""
        return bool(self.subscribers)

    def send(self, frames: Sequence[Frame], transport: Transport) -> None:
        """To every client that keeps up, and into the history for the others."""
        if self._encoding.fragments:
            frames = self._aside(frames)
        if not frames or not self.subscribers:
            return
        ready = [each for each in self.subscribers.values() if each.keeps_up]
        if len(ready) < len(self.subscribers):
            now = self._clock_ns()
            for each in self.subscribers.values():
                if not each.keeps_up and not each.is_behind:
                    each.fall_behind(now)
            self._history.add(frames)
        if len(ready) > 1:
            transport.write_all([each.client for each in ready], self._on_wire(frames, len(ready)))
            for each in ready:
                each.sent += len(frames)
        elif ready:
            ready[0].write(frames)

    def send_to(self, subscriber: Subscriber, frames: Sequence[Frame]) -> None:
        """Answers to one client; who does not read them gets no more."""
        if not frames:
            return
        if subscriber.keeps_up:
            subscriber.write(frames)
        else:
            subscriber.dropped += len(frames)
            self._ledger.superseded(len(frames))

    async def settle(self) -> None:
        """To be called now and then: counts what those who are behind will not get."""
        self._ledger.superseded(sum(each.settle() for each in self.subscribers.values()))
        if not any(each.is_behind for each in self.subscribers.values()):
            self._history.clear()
        self._log.flush()

    def joined(self, client: Client) -> Subscriber:
        taken = {each.number for each in self.subscribers.values()}
        number = next(number for number in count() if number not in taken)
        subscriber = self.subscribers[client] = Subscriber(client, number, self._history, self._on_wire)
        self._ledger.clients(len(self.subscribers))
        self._tell("client joined", subscriber)
        return subscriber

    def left(self, client: Client) -> None:
        if (subscriber := self.subscribers.pop(client, None)) is not None:
            self._ledger.superseded(subscriber.settle())
            self._ledger.left(subscriber.waiting)
            self._ledger.clients(len(self.subscribers))
            self._tell("client left", subscriber)

    def drained(self, client: Client) -> None:
        if (subscriber := self.subscribers.get(client)) is not None:
            self._ledger.superseded(subscriber.drained())

    def close(self) -> None:
        """Nobody is told any more."""
        self._log.flush(final=True)

    def _tell(self, event: str, subscriber: Subscriber) -> None:
        """Who comes and goes again and again from one host is summed up."""
        address = subscriber.client.label
        key = event, address.rpartition(":")[0]
        self._log.note(key, logger.info, event, gateway=self._gateway, client=subscriber.number, address=address)

    def _on_wire(self, frames: Sequence[Frame], clients: int = 1) -> Sequence[Frame]:
        wire = self._encoding.on_wire(frames, self._wall_s())
        self._ledger.written(len(wire) * clients, sum(len(frame.data) for frame in wire) * clients)
        return wire

    def _aside(self, frames: Sequence[Frame]) -> list[Frame]:
        """Those that are not large; the others go out a few datagrams at a time, of each topic the latest."""
        for frame in frames:
            if len(frame.data) > LARGE:
                self._ledger.superseded(frame.topic in self._large)
                self._large[frame.topic] = frame
        if self._large and not self._is_pumping:
            self._is_pumping = True
            self._tasks.run(self._pump())
        return [frame for frame in frames if len(frame.data) <= LARGE]

    async def _pump(self) -> None:
        try:
            while self._large:
                wire = self._on_wire([self._large.pop(next(iter(self._large)))])
                for start in range(0, len(wire), PUMPED):
                    for each in self.subscribers.values():
                        each.client.write(wire[start : start + PUMPED])
                    await asyncio.sleep(PUMP_S)
                for each in self.subscribers.values():
                    each.sent += 1
        finally:
            self._is_pumping = False
