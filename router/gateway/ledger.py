"""The counters of one gateway: what came from ROS, what clients got, and what was lost on the way."""

from __future__ import annotations

from collections.abc import Callable

from router.compiler.metrics import CLIENT_DROP_REASONS, CLIENTS, GATEWAY_DROP_REASONS, TOPIC_STATES, Counters
from router.engine import Report
from router.table.model import ROS, Gateway


class Ledger:
    """For the thread that owns `counts`. Every ROS message that came is sent, filtered or dropped, once.

    `wall_ns` is the wall clock.
    """

    def __init__(
        self,
        settings: Gateway,
        counters: Counters,
        counts: list[int],
        report: Callable[[Report], None],
        wall_ns: Callable[[], int],
    ) -> None:
        name, way = settings.name, settings.transport.value.value
        self._name = name
        self._counts = counts
        self._report = report
        self._wall_ns = wall_ns
        self._received = counters.index("messages_received", name, ROS)
        self._last = counters.index("route_last_message_timestamp_seconds", name)
        self._sent = counters.index("messages_sent", name, CLIENTS)
        self._filtered = counters.index("messages_filtered", name, CLIENTS)
        self._dropped = {
            reason: counters.index("messages_dropped", name, CLIENTS, reason) for reason in GATEWAY_DROP_REASONS
        }
        self._written = counters.index("datagrams_sent", name, way)
        self._written_bytes = counters.index("sent_bytes", name, way)
        self._arrived = counters.index("datagrams_received", name)
        self._arrived_bytes = counters.index("received_bytes", name)
        self._clients = counters.index("gateway_clients", name)
        self._topics = [counters.index("gateway_topics", name, state) for state in TOPIC_STATES]
        self._contended = counters.index("gateway_key_conflicts", name) if settings.zenoh else None
        self._lost = {reason: counters.index("client_messages_dropped", name, reason) for reason in CLIENT_DROP_REASONS}

    def received(self, times: int) -> None:
        """Messages came from ROS."""
        if times:
            self._counts[self._received] += times
            self._counts[self._last] = self._wall_ns()

    def sent(self) -> None:
        """One of them was handed to all clients."""
        self._counts[self._sent] += 1

    def filtered(self, times: int) -> None:
        """Some were not wanted: a newer one took their place, or there was no client."""
        self._counts[self._filtered] += times

    def dropped(
        self, reason: str, topic: str, error: Exception | None = None, detail: str = "", times: int = 1
    ) -> None:
        """No client got it, for one of GATEWAY_DROP_REASONS."""
        if times:
            self._counts[self._dropped[reason]] += times
            self._report(Report("drop", self._name, topic, reason, error, detail))

    def written(self, frames: int, size: int) -> None:
        """Datagrams, packets or documents went to the transport."""
        self._counts[self._written] += frames
        self._counts[self._written_bytes] += size

    def arrived(self, size: int) -> None:
        """A client sent something."""
        self._counts[self._arrived] += 1
        self._counts[self._arrived_bytes] += size

    def superseded(self, times: int) -> None:
        self._counts[self._lost["superseded"]] += times

    def left(self, times: int) -> None:
        self._counts[self._lost["left"]] += times

    def send_error(self, error: Exception, times: int) -> None:
        self._counts[self._lost["send_error"]] += times
        self._report(Report("drop", self._name, CLIENTS, "send_error", error))

    def contended(self) -> None:
        """Another gateway has the same key. Only Zenoh has keys."""
        if self._contended is not None:
            self._counts[self._contended] += 1

    def clients(self, number: int) -> None:
        self._counts[self._clients] = number

    def topics(self, served: int, several_types: int, not_installed: int) -> None:
        for index, number in zip(self._topics, (served, several_types, not_installed), strict=True):
            self._counts[index] = number
