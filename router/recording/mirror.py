"""Shows what listeners receive, before routing, to whoever wants to see it: recordings, taps, pages.

Knows no envelope and no route. While nobody watches, nothing of this is in the way of a datagram.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

from router.clock import wall_ns

Receive = Callable[[bytes, "tuple[str, int]"], None]

PERIOD = 0.05
"""Seconds for which datagrams gather until they are shown: waking somebody for each would cost more than routing it."""

MOST = 8192
"""Datagrams that wait to be shown. More are counted as lost, so that a slow consumer never holds up routing."""


class Seen(NamedTuple):
    """A datagram: when the router took it (wall clock, ns), on which listener, from whom, and its bytes.

    Of one that is longer than the router takes there are the first `limit` + 1 bytes.
    """

    at: int
    listener: str
    peer: tuple[str, int]
    data: bytes


Shown = tuple[int, str, "tuple[str, int]", bytes]
"""What a Seen has, in its order: of thousands in a second, names alone would cost as much as all else here."""

Consumer = Callable[[Sequence[Shown]], None]


class Mirror:
    """Consumers are called by one thread, up to PERIOD after the datagram; none may keep it for long.

    `rewire` is called when the first consumer has come and when the last has gone: who receives then asks `tee` anew
    for what to call. Datagrams have at most `limit` bytes. What a consumer raises goes to `failed`.
    """

    def __init__(self, limit: int, rewire: Callable[[], None], failed: Callable[[Exception], None]) -> None:
        self.lost = 0
        """Datagrams that were routed, but not shown."""
        self._limit = limit
        self._rewire = rewire
        self._failed = failed
        self._waiting: deque[Shown] = deque()
        self._consumers: tuple[Consumer, ...] = ()
        self._attaching = threading.Lock()
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    def attach(self, consumer: Consumer) -> Callable[[], None]:
        """Has `consumer` called with all that is received from now on. Returns what ends that.

        After that it may be called once more if it is being called; not to be ended by the consumer itself.
        """
        with self._attaching:
            self._consumers = (*self._consumers, consumer)
            if len(self._consumers) == 1:
                self._stopping = threading.Event()
                self._thread = threading.Thread(target=self._run, name="mirror", args=(self._stopping,), daemon=True)
                self._thread.start()
                self._rewire()

        def detach() -> None:
            with self._attaching:
                if not any(each is consumer for each in self._consumers):
                    return
                if len(self._consumers) == 1:
                    self._end()
                self._consumers = tuple(each for each in self._consumers if each is not consumer)
                if not self._consumers:
                    self._rewire()
                    self._waiting.clear()

        return detach

    def tee(self, listener: str, receive: Receive) -> Receive:
        """What is to be called in place of `receive` for this listener's datagrams, as long as nobody comes or goes."""
        if not self._consumers:
            return receive
        waiting, append, most = self._waiting, self._waiting.append, self._limit + 1

        def seen(data: bytes, peer: tuple[str, int]) -> None:
            if len(waiting) < MOST:
                append((wall_ns(), listener, peer, data[:most]))
            else:
                self.lost += 1
            receive(data, peer)

        return seen

    def close(self) -> None:
        """Nothing is received any more: shows what waits, and ends."""
        with self._attaching:
            if self._consumers:
                self._end()

    def _end(self) -> None:
        assert self._thread is not None  # noqa: S101 - there is one while there are consumers
        self._stopping.set()
        self._thread.join()
        self._show()

    def _run(self, stopping: threading.Event) -> None:
        while not stopping.wait(PERIOD):
            self._show()

    def _show(self) -> None:
        """Called by the thread, and by whoever has waited for its end: never by two at once."""
        pop = self._waiting.popleft
        batch = [pop() for _ in range(len(self._waiting))]
        if not batch:
            return
        for consumer in self._consumers:
            try:
                consumer(batch)
            except Exception as error:  # noqa: BLE001 a fault of the router, told loudly; the others see it all the same
                self._failed(error)
