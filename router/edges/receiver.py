"""The receive thread: takes datagrams from all listeners and gives each to whoever it is for, until told to stop.

Where datagrams come thick, it lets some of them gather before it looks again; where they do not, it waits for each.
"""

from __future__ import annotations

import select
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from time import monotonic_ns

from router.edges.coalescing import SAMPLE, Coalescing
from router.edges.udp import Listener

Receive = Callable[[bytes, "tuple[str, int]"], None]

_WAIT = socket.MSG_TRUNC.value
_LOOK = _WAIT | socket.MSG_DONTWAIT.value

_TURN = 4
"""The most that one of several listeners may hand in while the others wait."""


class ReceiveThread:
    """Calls `receive[listener](data, peer)` for each datagram, on one thread of its own.

    `limit` is the longest datagram in bytes that is received whole. A longer one arrives with its true
    length (MSG_TRUNC), its tail being whatever the memory held: the receiver must refuse it by length.
    `enough` tells how many datagrams of a listener may gather before they are looked at (see `coalescing`).
    What `receive` raises goes to `failed`, and receiving goes on.
    """

    def __init__(
        self,
        listeners: Sequence[Listener],
        receive: Mapping[str, Receive],
        limit: int,
        enough: Callable[[], int],
        failed: Callable[[Exception], None],
    ) -> None:
        self._listeners = listeners
        self._intakes = [_Intake(listener, receive[listener.name], limit + 1, enough) for listener in listeners]
        self._failed = failed
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="receive")

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """Lets nothing new in, handles what the kernel already holds, and returns when that is done."""
        for listener in self._listeners:
            listener.end_input()
        self._ended = True
        self._thread.join()

    def _run(self) -> None:
        receive_all = self._from_one if len(self._intakes) == 1 else self._from_many
        while True:
            try:
                return receive_all()
            except Exception as error:  # noqa: BLE001 a fault of the router, told loudly, is no reason to stop receiving
                self._failed(error)

    def _from_one(self) -> None:
        """One system call per datagram: a blocking receive is also the wait."""
        [intake] = self._intakes
        receive, receive_from, size = intake.receive, intake.receive_from, intake.size
        while True:
            since = monotonic_ns()
            for _ in range(SAMPLE):
                data, peer = receive_from(size, _WAIT)
                if peer is None:
                    return
                receive(data, peer)
            if intake.coalescing.begins(monotonic_ns() - since):
                taken = SAMPLE
                while rest := intake.coalescing.rest(taken):
                    time.sleep(rest)
                    taken = intake.take(sys.maxsize)

    def _from_many(self) -> None:
        """Few datagrams per listener and turn, so that a flooded listener cannot starve the others."""
        with select.epoll() as waiting:
            open_ones = {intake.descriptor: intake for intake in self._intakes}
            for descriptor in open_ones:
                waiting.register(descriptor, select.EPOLLIN)
            resting: dict[int, float] = {}  # until when, by time.monotonic
            while open_ones:
                ended = self._ended  # before looking: what arrives after that is still taken
                for descriptor, _ in waiting.poll(_until(resting)):
                    taken, rest = open_ones[descriptor].take_turn()
                    if not taken and ended:
                        waiting.unregister(descriptor)
                        del open_ones[descriptor]
                    elif rest:
                        waiting.modify(descriptor, 0)
                        resting[descriptor] = time.monotonic() + rest
                for descriptor in _rested(resting):
                    waiting.modify(descriptor, select.EPOLLIN)
                    del resting[descriptor]


def _until(resting: Mapping[int, float]) -> float | None:
    """Seconds until the first has rested."""
    return max(0.0, min(resting.values()) - time.monotonic()) if resting else None


def _rested(resting: Mapping[int, float]) -> list[int]:
    now = time.monotonic() if resting else 0.0
    return [descriptor for descriptor, until in resting.items() if until <= now]


class _Intake:
    """One listener's datagrams, and whether it rests between looks."""

    def __init__(self, listener: Listener, receive: Receive, size: int, enough: Callable[[], int]) -> None:
        self.descriptor = listener.socket.fileno()
        self.receive_from = listener.socket.recvfrom
        self.receive = receive
        self.size = size
        self.coalescing = Coalescing(listener.coalesce, enough)
        self._is_coalescing = False
        self._taken = 0  # since the last look at the clock, or the last rest
        self._since = 0

    def take(self, most: int) -> int:
        """Takes what has arrived, and returns how much that was: less than `most` when there is no more."""
        receive, receive_from, size, flags = self.receive, self.receive_from, self.size, _LOOK
        for taken in range(most):
            try:
                data, peer = receive_from(size, flags)
            except BlockingIOError:  # also for one that arrived damaged
                return taken
            receive(data, peer)
        return most

    def take_turn(self) -> tuple[int, float]:
        """The turn of one of several listeners: how many datagrams it took, and the seconds for which it rests."""
        return self._take_some() if self._is_coalescing else (self._take_one(), 0.0)

    def _take_one(self) -> int:
        taken = self.take(1)
        self._taken += taken
        if self._taken == SAMPLE:
            now = monotonic_ns()
            self._is_coalescing = self.coalescing.begins(now - self._since)
            self._taken, self._since = 0, now
        return taken

    def _take_some(self) -> tuple[int, float]:
        taken = self.take(_TURN)
        self._taken += taken
        if taken == _TURN:
            return taken, 0.0
        rest = self.coalescing.rest(self._taken)
        self._is_coalescing = rest > 0
        self._taken, self._since = 0, monotonic_ns()
        return taken, rest
