"""The clients of one gateway. Each gets frames at once or, while it is behind, the newest frame of each topic."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Hashable, Mapping, Sequence
from itertools import count
from typing import Any

from router.gateway.counters import GatewayCounters
from router.gateway.encoding import Encoding
from router.gateway.latched import MOST_LATCHED_BYTES
from router.gateway.transport.base import HIGH_WATER, Client, Frame, Transport
from router.log import FloodLog, logger

MOST_BACKLOG = 256 << 20
"""Bytes that wait for all clients of a gateway at which no more latched messages are sent."""


class ClientQueue:
    """The output of one client. `number` is its label in metrics: the lowest that no other client of the gateway has.

    While its backlog is at HIGH_WATER, frames wait in a queue that holds one per topic (and schema). A newer frame
    replaces the one in the queue and keeps its place. `sent` and `dropped` count frames since the client joined. Times
    are on the boot clock, in ns.
    """

    def __init__(self, client: Client, number: int, on_wire: Callable[[Sequence[Frame]], Sequence[Frame]]) -> None:
        self.client = client
        self.number = number
        self.sent = 0
        self.dropped = 0
        self.missed_topics: set[str] = set()
        """Topics with a queued frame that a newer one replaced."""
        self.shown: dict[str, set[int]] = {}
        """Times of publication (ns) of the latched messages that the client has, of topics that it has in part."""
        self.has_left = False
        self._on_wire = on_wire
        self._drained: asyncio.Future[None] | None = None
        self._behind_since: int | None = None
        self._schemas: dict[Hashable, Frame] = {}
        self._values: dict[str, Frame] = {}
        self._held: dict[str, list[Frame]] = {}
        self._held_bytes = 0
        self._held_incomplete: set[str] = set()

    @property
    def waiting(self) -> int:
        """Frames in the queue."""
        return len(self._schemas) + len(self._values)

    @property
    def held(self) -> int:
        """Frames that wait for the latched messages of their topic."""
        return sum(map(len, self._held.values()))

    @property
    def holds(self) -> bool:
        """Whether the latched messages of any topic are on their way."""
        return bool(self._held)

    def is_held(self, topic: str) -> bool:
        """Whether the latched messages of this topic are on their way."""
        return topic in self._held

    def record_miss(self, topic: str) -> None:
        """Record that the client missed a message of the topic, unless latched messages on their way include it."""
        (self._held_incomplete if topic in self._held else self.missed_topics).add(topic)

    @property
    def keeps_up(self) -> bool:
        """Whether frames can be written at once."""
        return self._behind_since is None and self.client.backlog() < HIGH_WATER

    def lag(self, now: int) -> int:
        """Return how long (ns) the client has been behind."""
        return 0 if self._behind_since is None else now - self._behind_since

    def write(self, frames: Sequence[Frame]) -> None:
        self.client.write(self._on_wire(frames))
        self.sent += len(frames)

    def hold(self, topic: str) -> bool:
        """Hold values of the topic until `release`, because its latched messages come first.

        Return False if they are held already.
        """
        if topic in self._held:
            return False
        self._held[topic] = []
        return True

    async def takes_more(self, patience: float, until: float) -> bool:
        """Wait until frames can be written at once.

        Return False if the client takes nothing for `patience` s, at the time `until` of the loop, or once it has left.
        """
        loop = asyncio.get_running_loop()
        while not self.keeps_up and not self.has_left:
            if self._drained is None:
                self._drained = loop.create_future()
            before = self.client.backlog()
            done, _ = await asyncio.wait([self._drained], timeout=max(0.0, min(patience, until - loop.time())))
            if not done and (loop.time() >= until or self.client.backlog() >= before):
                return False
        return not self.has_left

    def leave(self) -> None:
        """Free all frames: the client has left."""
        self.has_left = True
        for frames in (self._schemas, self._values, self._held, self.shown):
            frames.clear()
        self._wake()

    def _wake(self) -> None:
        if self._drained is not None:
            self._drained.set_result(None)
            self._drained = None

    def release(self, topic: str, *, is_complete: bool = False) -> list[Frame]:
        """Return the held values of the topic, in order. `is_complete`: the latched messages include all so far."""
        if topic in self._held_incomplete:
            self._held_incomplete.discard(topic)
            if not is_complete:
                self.missed_topics.add(topic)
        frames = self._held.pop(topic, [])
        self._held_bytes -= sum(len(frame.data) for frame in frames)
        return frames

    def held_before(self, topic: str, sent_ns: float) -> list[Frame]:
        """Return the held values of the topic that were published before this time; they stay held."""
        return [frame for frame in self._held.get(topic, ()) if frame.sent_ns < sent_ns]

    def hold_back(self, frames: Sequence[Frame]) -> list[Frame]:
        """Return the frames that can be sent now, and hold the others. If these get too large, release all."""
        passed: list[Frame] = []
        for frame in frames:
            if frame.is_schema or frame.topic not in self._held:
                passed.append(frame)
                continue
            self._held[frame.topic].append(frame)
            self._held_bytes += len(frame.data)
        if self._held_bytes > MOST_LATCHED_BYTES:
            for topic in list(self._held):
                passed += self.release(topic)
        return passed

    def put(self, schemas: Mapping[Hashable, Frame], values: Mapping[str, Frame], frames: int, now: int) -> int:
        """Queue `schemas` and `values`, the newest per key of `frames` frames. Return how many newer ones replaced."""
        if self._behind_since is None:
            self._behind_since = now
        before = self.waiting
        self.missed_topics |= self._values.keys() & values.keys()
        self._schemas.update(schemas)
        self._values.update(values)
        superseded = before + frames - self.waiting
        self.dropped += superseded
        return superseded

    def drained(self) -> None:
        """Write as much of the queue as the client can take, schemas first."""
        while self.waiting and self.client.backlog() < HIGH_WATER:
            self.write(self._take())
        if not self.waiting:
            self._behind_since = None
            self._wake()

    def _take(self) -> list[Frame]:
        """Remove frames from the front of the queue: HIGH_WATER bytes, or one frame that is larger."""
        taken: list[Frame] = []
        size = 0
        queues: tuple[dict[Any, Frame], ...] = self._schemas, self._values
        for queue in queues:
            for key, frame in list(queue.items()):
                size += len(frame.data)
                if taken and size > HIGH_WATER:
                    return taken
                taken.append(frame)
                del queue[key]
        return taken


class Clients:
    """All clients of a gateway. `clock_ns` is the boot clock, `wall_s` gives the wall clock in seconds.

    Flush `log` regularly.
    """

    def __init__(
        self,
        gateway: str,
        transport: Transport,
        encoding: Encoding,
        counters: GatewayCounters,
        clock_ns: Callable[[], int],
        wall_s: Callable[[], float],
    ) -> None:
        self.queues: dict[Client, ClientQueue] = {}
        self._gateway = gateway
        self._transport = transport
        self._encoding = encoding
        self._counters = counters
        self._clock_ns = clock_ns
        self._wall_s = wall_s
        self.log = FloodLog()

    def __bool__(self) -> bool:
        """Return whether there are any clients."""
        return bool(self.queues)

    def send(self, frames: Sequence[Frame]) -> None:
        """Write frames to every client that keeps up, and queue them for the others."""
        if not frames or not self.queues:
            return
        ready: list[ClientQueue] = []
        behind: list[ClientQueue] = []
        for queue in self.queues.values():
            if queue.holds:
                self.send_to(queue, queue.hold_back(frames))
            else:
                (ready if queue.keeps_up else behind).append(queue)
        if behind:
            self._queue(behind, frames)
        if len(ready) > 1:
            self._transport.write_all([queue.client for queue in ready], self._on_wire(frames, len(ready)))
            for queue in ready:
                queue.sent += len(frames)
        elif ready:
            ready[0].write(frames)

    def has_room(self, size: int) -> bool:
        """Return whether the backlogs of all clients leave room for a latched message of this size."""
        backlog = sum(queue.backlog() for queue in self.queues)
        return backlog == 0 or backlog + size <= MOST_BACKLOG

    def record_miss(self, topic: str) -> None:
        """Record that all clients missed a message of the topic."""
        for queue in self.queues.values():
            queue.record_miss(topic)

    def send_to(self, queue: ClientQueue, frames: Sequence[Frame]) -> None:
        """Send frames to one client."""
        if not frames:
            return
        if queue.keeps_up:
            queue.write(frames)
        else:
            self._queue([queue], frames)

    def joined(self, client: Client) -> ClientQueue:
        taken = {queue.number for queue in self.queues.values()}
        number = next(number for number in count() if number not in taken)
        queue = self.queues[client] = ClientQueue(client, number, self._on_wire)
        self._counters.clients(len(self.queues))
        self._log_change("client joined", queue)
        return queue

    def left(self, client: Client) -> None:
        if (queue := self.queues.pop(client, None)) is not None:
            self._counters.left(queue.waiting + queue.held)
            queue.leave()
            self._counters.clients(len(self.queues))
            self._log_change("client left", queue)

    def drained(self, client: Client) -> None:
        if (queue := self.queues.get(client)) is not None:
            queue.drained()

    def _queue(self, queues: Sequence[ClientQueue], frames: Sequence[Frame]) -> None:
        schemas: dict[Hashable, Frame] = {(frame.topic, frame.type_name): frame for frame in frames if frame.is_schema}
        values: dict[str, Frame] = {}
        for frame in frames:
            if frame.is_schema:
                continue
            if frame.topic in values:
                for queue in queues:
                    queue.missed_topics.add(frame.topic)
            values[frame.topic] = frame
        now = self._clock_ns()
        self._counters.superseded(sum(queue.put(schemas, values, len(frames), now) for queue in queues))

    def _log_change(self, event: str, queue: ClientQueue) -> None:
        """Log that a client joined or left; the log summarizes repetitions from one host."""
        address = queue.client.label
        key = event, address.rpartition(":")[0]
        self.log.note(key, logger.info, event, gateway=self._gateway, client=queue.number, address=address)

    def _on_wire(self, frames: Sequence[Frame], clients: int = 1) -> Sequence[Frame]:
        wire = self._encoding.on_wire(frames, self._wall_s())
        self._counters.written(len(wire) * clients, sum(len(frame.data) for frame in wire) * clients)
        return wire
