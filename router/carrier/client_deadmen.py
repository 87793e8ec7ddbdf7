"""Deadmen of gateway clients. They have a native thread of their own, because they publish, which may block."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterable, Mapping, Sequence
from time import monotonic, sleep

from router.carrier.deadmen import NativeDeadman, destinations_of, replaced, settings
from router.carrier.names import Names
from router.carrier.outlets import AwaitedPublication
from router.carrier.ring import Ring
from router.carrier.state import State
from router.carrier.threads import NativeThread
from router.clock import monotonic_ns
from router.compiler.metrics import Counters
from router.compiler.program import DeadmanPlan
from router.errors import StartError
from router.log import logger

_POLL_S = 0.002

RECEIPT_S = 0.5
"""How long, in seconds, a reload or the stop waits until subscriptions have received the last messages of deadmen."""


class ClientDeadman(NativeDeadman):
    """The deadman of a topic that clients of a gateway may publish on. Times in ns of the boot clock.

    `publications` has its topics. No call waits for the middleware.
    """

    def __init__(
        self, library: ctypes.CDLL, group: int, address: int, topics: Sequence[str], used: Sequence[AwaitedPublication]
    ) -> None:
        super().__init__(library, group, address, topics, used)
        self.publications = dict(zip(topics, used, strict=True))

    def feed(self, now: int) -> None:
        """Feed the deadman after a client's message is published; `now` is a time before the publish call."""
        self._library.deadman_feed(self._deadmen, self.address, now)

    def await_subscribers(self, now: int) -> None:
        """Publish to each subscriber discovered shortly after the start, unless the table says otherwise."""
        self._library.deadman_await_subscribers(self._deadmen, self.address, now)

    def greet(self, now: int) -> bool:
        """Handle a new subscriber. Return whether the deadman publishes to it, because no client has published yet."""
        return bool(self._library.deadman_greet(self._deadmen, self.address, now))

    def end(self) -> None:
        """Have the thread publish a last time if the deadman is armed or tripped."""
        self._library.deadman_end_by_thread(self._deadmen, self.address)


class ClientDeadmen(NativeThread):
    """All deadmen of gateway clients, and their thread; never closed. They report to `events`."""

    def __init__(self, library: ctypes.CDLL, counts: ctypes.Array[ctypes.c_int64], events: Ring, names: Names) -> None:
        """Raises MemoryError."""
        super().__init__(library, counts, events)
        self.name = "client deadmen"
        self._names = names
        self._address = int(library.client_deadmen_open(counts, events.address) or 0)
        if not self._address:
            raise MemoryError("the deadmen of gateways cannot be opened")
        self.group: int = library.client_deadmen_group(self._address)
        """The address of their `struct timers`."""
        self._has_started = False

    def start(self, functions: tuple[int, int, int]) -> None:
        """Start the thread if it is not running. `functions` are the addresses in `ros.rcl.PublishFunctions`.

        Raises StartError.
        """
        if not self._has_started:
            error = self._library.client_deadmen_start(self._address, *functions)
            if error:
                raise StartError(f"the thread for deadmen of clients cannot be started: {os.strerror(error)}")
            self._has_started = True

    def get_or_open(
        self, plan: DeadmanPlan, counters: Counters, publications: Mapping[str, AwaitedPublication], state: State
    ) -> ClientDeadman:
        """Return the deadman of a topic. Programs with the same plan and publisher share it. Raises MemoryError."""
        topics = [topic for topic, _ in plan.datagrams]
        used = [publications[topic] for topic in topics]
        return state.get_or_open(
            ("client deadman", plan.route),
            (plan, *used),
            lambda address: ClientDeadman(self._library, self.group, address, topics, used),
            "deadman_open",
            self.group,
            *settings(plan, counters, self._names),
            *destinations_of(plan, counters, self._names, used, "publisher"),
        )

    def adopt(self, before: Mapping[str, ClientDeadman], now: Mapping[str, ClientDeadman], generation: int) -> None:
        """Replace the deadmen of one program with those of the next, which has this generation. Both are by name.

        A deadman with changed settings inherits the state of the earlier one. Those without a successor publish a last
        time if they are armed; wait, but not long, until subscriptions have received that.
        """
        ended = [before[name] for name in before.keys() - now.keys()]
        for deadman in ended:
            deadman.end()
        for each, earlier in replaced(now, before, {name: name for name in now}):
            self._library.deadman_replace(self.group, each.address, earlier.address)
        self._library.client_deadmen_advance(self._address, generation)
        if ended and self.wait_for(generation, RECEIPT_S):
            await_receipt(ended)

    def wait_for(self, generation: int, timeout: float) -> bool:
        """Wait until no publisher of earlier generations is in use. Return False after `timeout` s."""
        for _ in range(int(timeout / _POLL_S)):
            if not self._has_started or self._library.client_deadmen_have_reached(self._address, generation):
                return True
            sleep(_POLL_S)
        return False

    def stalled(self) -> tuple[str, float] | None:
        """Return the topic on which the thread is publishing now, and for how many seconds; None if there is none."""
        topic = ctypes.c_uint32()
        since = self._library.client_deadmen_since(self._address, ctypes.byref(topic))
        return (self._names.name(topic.value), (monotonic_ns() - since) / 1e9) if since else None

    def stop(self) -> bool:
        """Have armed deadmen publish a last time, and end the thread.

        Return False if it is stuck in the middleware after 1 s: then it keeps running, and publishers must stay open.
        Idempotent.
        """
        return bool(self._library.client_deadmen_stop(self._address))


def await_receipt(deadmen: Iterable[ClientDeadman]) -> None:
    """Wait until subscriptions have received what these deadmen have published; log which ones have not in time."""
    until = monotonic() + RECEIPT_S
    publications = {topic: each for deadman in deadmen for topic, each in deadman.publications.items()}
    late = [topic for topic, each in publications.items() if not each.await_receipt(max(until - monotonic(), 0.0))]
    if late:
        event = "subscribers may lack the last message of a deadman: they have not acknowledged it in time; continuing"
        logger.warning(event, topics=late, seconds=RECEIPT_S)
