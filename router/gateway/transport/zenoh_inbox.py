"""What comes from a Zenoh network, from its threads into the loop's: bounded, and a few at a time. Knows no session."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable

import zenoh

from router.gateway.transport.arrival import LoopClock, stamp
from router.gateway.transport.base import Client, Ears
from router.gateway.transport.memory import Trimmer

RECEIVED_PER_TURN = 32
"""Samples that are handed on before other work of the loop has its turn."""

MOST_RECEIVED = 1000
MOST_RECEIVED_BYTES = 64 << 20
"""What waits at most to be handed on; samples beyond that are refused."""

MOST_ASKING = 100
"""Queries that wait at most for answers, each of which may be large."""


class Inbox:
    """Samples. `most` bounds in bytes what is received as one. Each counter is written by one thread alone."""

    def __init__(self, ears: Ears, most: int) -> None:
        self._client: Client | None = None
        self._ears = ears
        self._most = most
        self._loop = asyncio.get_running_loop()
        self._waiting: deque[tuple[bytes, int]] = deque()
        self._heard_bytes = self._handed_bytes = 0
        self._lost = self._told_lost = 0
        self._clock = LoopClock()
        self._trimmer = Trimmer()

    def start(self, client: Client) -> None:
        """Hands on what comes, from `client`."""
        self._client = client
        self._clock.start()
        self._hand_on()

    def stop(self) -> None:
        self._client = None
        self._clock.stop()
        self._trimmer.close()

    def hear(self, sample: zenoh.Sample) -> None:
        """For Zenoh's thread."""
        if sample.kind != zenoh.SampleKind.PUT:  # never `is`: each is made anew
            return
        size = len(sample.payload)
        if size > self._most:
            self._loop.call_soon_threadsafe(self._ears.refused, "too_large")
        elif len(self._waiting) >= MOST_RECEIVED or self._heard_bytes - self._handed_bytes + size > MOST_RECEIVED_BYTES:
            self._lost += 1  # told with those that wait
        else:
            self._heard_bytes += size
            self._waiting.append((sample.payload.to_bytes(), stamp(self._clock.away_since())))
            if len(self._waiting) == 1:
                self._loop.call_soon_threadsafe(self._hand_on)

    def _hand_on(self) -> None:
        if self._client is None:
            return
        try:
            for _ in range(min(len(self._waiting), RECEIVED_PER_TURN)):
                data, arrived = self._waiting.popleft()
                self._handed_bytes += len(data)
                self._ears.received(self._client, data, arrived)
                self._trimmer.freed(len(data))
        finally:
            if self._waiting:  # else `hear` calls
                self._loop.call_soon(self._hand_on)
        for _ in range(self._lost - self._told_lost):
            self._told_lost += 1
            self._ears.refused("rate_limited")


class Queries:
    """Queries that wait for an answer. `wake` is called in the loop when there is one after there was none."""

    def __init__(self, wake: Callable[[], None]) -> None:
        self._wake = wake
        self._loop = asyncio.get_running_loop()
        self._waiting: deque[zenoh.Query] = deque()

    def hear(self, query: zenoh.Query) -> None:
        """For Zenoh's thread."""
        if len(self._waiting) >= MOST_ASKING:
            with query:
                query.reply_err("too many queries wait for an answer: ask again")
            return
        self._waiting.append(query)
        if len(self._waiting) == 1:
            self._loop.call_soon_threadsafe(self._wake)

    def take(self) -> list[zenoh.Query]:
        """All that wait now."""
        return [self._waiting.popleft() for _ in range(len(self._waiting))]
