"""The counters of one gateway: messages from ROS, frames for clients, and losses."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from router.compiler.metrics import CLIENT_DROP_REASONS, CLIENTS, GATEWAY_DROP_REASONS, TOPIC_STATES, Counters, Report
from router.table.model.gateways import Gateway
from router.table.model.routes import ROS


class GatewayCounters:
    """Counts each ROS message once as sent, filtered or dropped.

    Use it only in the thread that owns `counts`. `clock_ns` is the boot clock.
    """

    def __init__(
        self,
        settings: Gateway,
        counters: Counters,
        counts: list[int],
        report: Callable[[Report], None],
        clock_ns: Callable[[], int],
    ) -> None:
        name, transport = settings.name, settings.transport.value.value
        self._name = name
        self._counts = counts
        self._report = report
        self._clock_ns = clock_ns
        self._received = counters.index("messages_received", name, ROS)
        self._last = counters.index("route_silence_seconds", name)
        self._sent = counters.index("messages_sent", name, CLIENTS)
        self._filtered = counters.index("messages_filtered", name, CLIENTS)
        self._dropped = {
            reason: counters.index("messages_dropped", name, CLIENTS, reason) for reason in GATEWAY_DROP_REASONS
        }
        self._written = counters.index("datagrams_sent", name, transport)
        self._written_bytes = counters.index("sent_bytes", name, transport)
        self._arrived = counters.index("datagrams_received", name)
        self._arrived_bytes = counters.index("received_bytes", name)
        self._clients = counters.index("gateway_clients", name)
        self._topics = {state: counters.index("gateway_topics", name, state) for state in TOPIC_STATES}
        zenoh = settings.zenoh
        self._contended = counters.index("gateway_key_conflicts", name) if zenoh else None
        self._connections = counters.index("gateway_connections", name, zenoh.mode) if zenoh else None
        self._lost = {reason: counters.index("client_messages_dropped", name, reason) for reason in CLIENT_DROP_REASONS}

    def received(self, messages: int) -> None:
        """Count messages from ROS."""
        if messages:
            self._counts[self._received] += messages
            self._counts[self._last] = self._clock_ns()

    def sent(self) -> None:
        """Count a ROS message that was sent to all clients."""
        self._counts[self._sent] += 1

    def filtered(self, messages: int) -> None:
        """Count messages that newer ones replaced within their period, or for which there was no client."""
        self._counts[self._filtered] += messages

    def dropped(
        self, reason: str, topic: str, error: Exception | None = None, detail: str = "", messages: int = 1
    ) -> None:
        """Count and report messages that no client got, for one of GATEWAY_DROP_REASONS."""
        if messages:
            self._counts[self._dropped[reason]] += messages
            self._report(Report("drop", self._name, topic, reason, error, detail))

    def written(self, frames: int, size: int) -> None:
        """Count datagrams, packets or documents that were given to the transport."""
        self._counts[self._written] += frames
        self._counts[self._written_bytes] += size

    def arrived(self, size: int) -> None:
        """Count a datagram, packet or document from a client."""
        self._counts[self._arrived] += 1
        self._counts[self._arrived_bytes] += size

    def superseded(self, frames: int) -> None:
        """Count frames for a slow client that newer ones replaced."""
        self._counts[self._lost["superseded"]] += frames

    def left(self, frames: int) -> None:
        """Count frames that were queued for a client when it left."""
        self._counts[self._lost["left"]] += frames

    def send_error(self, error: Exception, frames: int) -> None:
        self._counts[self._lost["send_error"]] += frames
        self._report(Report("drop", self._name, CLIENTS, "send_error", error))

    def contended(self) -> None:
        """Count a conflict with another gateway that uses the same Zenoh key."""
        if self._contended is not None:
            self._counts[self._contended] += 1

    def connected(self, number: int) -> None:
        """Set the number of connected Zenoh routers and peers."""
        if self._connections is not None:
            self._counts[self._connections] = number

    def clients(self, number: int) -> None:
        self._counts[self._clients] = number

    def topics(self, numbers: Mapping[str, int]) -> None:
        """Set the number of topics, by one of TOPIC_STATES; 0 if it is absent."""
        for state, index in self._topics.items():
            self._counts[index] = numbers.get(state, 0)
