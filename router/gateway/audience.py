"""The clients of one gateway: who gets a frame at once, who later, and what goes out between other frames."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from itertools import count

from router.edges.gateway_transport import Client, Frame, Transport
from router.edges.log import logger
from router.gateway.encoding import LARGE, Encoding
from router.gateway.ledger import Ledger
from router.gateway.outbox import Outbox
from router.gateway.subscriber import Subscriber
from router.gateway.tasks import Tasks

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
        self._bulk = Outbox(0)  # of each topic the latest
        self._is_pumping = False

    def __bool__(self) -> bool:
        """Whether there is anybody."""
        return bool(self.subscribers)

    def send(self, frames: Sequence[Frame], transport: Transport) -> None:
        """To every client: at once, or into the queue of one that is slow."""
        if not frames or not self.subscribers:
            return
        if self._encoding.fragments:
            frames = self._aside(frames)
        ready = [each for each in self.subscribers.values() if each.keeps_up]
        slow = [each for each in self.subscribers.values() if not each.keeps_up]
        if len(ready) > 1:
            transport.write_all([each.client for each in ready], self._on_wire(frames, len(ready)))
            for each in ready:
                each.sent += len(frames)
        elif ready:
            self.send_to(ready[0], frames)
        for each in slow:
            self.send_to(each, frames)

    def send_to(self, subscriber: Subscriber, frames: Sequence[Frame]) -> None:
        if frames:
            self._ledger.superseded(subscriber.send(frames, self._clock_ns()))

    def joined(self, client: Client) -> Subscriber:
        taken = {each.number for each in self.subscribers.values()}
        number = next(number for number in count() if number not in taken)
        subscriber = self.subscribers[client] = Subscriber(client, number, self._on_wire)
        self._ledger.clients(len(self.subscribers))
        logger.info("client joined", gateway=self._gateway, client=number, address=client.label)
        return subscriber

    def left(self, client: Client) -> None:
        if (subscriber := self.subscribers.pop(client, None)) is not None:
            self._ledger.left(subscriber.waiting)
            self._ledger.clients(len(self.subscribers))
            logger.info("client left", gateway=self._gateway, client=subscriber.number, address=client.label)

    def drained(self, client: Client) -> None:
        if (subscriber := self.subscribers.get(client)) is not None:
            subscriber.drained()

    def _on_wire(self, frames: Sequence[Frame], clients: int = 1) -> Sequence[Frame]:
        wire = self._encoding.on_wire(frames, self._wall_s())
        self._ledger.written(len(wire) * clients, sum(len(frame.data) for frame in wire) * clients)
        return wire

    def _aside(self, frames: Sequence[Frame]) -> list[Frame]:
        """Those that are not large; the others go out a few datagrams at a time."""
        now = self._clock_ns()
        for frame in frames:
            if len(frame.data) > LARGE:
                self._ledger.superseded(self._bulk.offer(frame, now))
        if len(self._bulk) and not self._is_pumping:
            self._is_pumping = True
            self._tasks.run(self._pump())
        return [frame for frame in frames if len(frame.data) <= LARGE]

    async def _pump(self) -> None:
        try:
            while len(self._bulk):
                frames = self._bulk.take(1)
                wire = self._on_wire(frames)
                for start in range(0, len(wire), PUMPED):
                    for each in self.subscribers.values():
                        each.client.write(wire[start : start + PUMPED])
                    await asyncio.sleep(PUMP_S)
                for each in self.subscribers.values():
                    each.sent += len(frames)
        finally:
            self._is_pumping = False
