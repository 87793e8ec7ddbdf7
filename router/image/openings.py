"""The objects that a table needs open: the state of its targets and deadmen, which lasts from message to message.

Each is opened once for each key and passed on at a reload, so what else identifies an object has to contain everything
that it depends on, besides its arguments.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import astuple, dataclass, field
from math import ceil
from typing import TYPE_CHECKING, Any

from router import declared as c
from router.compiler.checked import Target
from router.compiler.compiled_table import Beside, CompiledTable, DeadmanPlan, RoutePlan, StatePlan, TopicPlan
from router.compiler.metrics import Counters
from router.hosts import host_number, is_ipv6
from router.image.memory import Symbols
from router.image.names import Names
from router.table.addresses import LinkPlace
from router.table.model.endpoints import Endpoint, Listener
from router.table.model.serial import LENGTHS, SerialLine
from router.table.model.tcp import TcpClient, TcpServer

if TYPE_CHECKING:
    from router.image.image import Symbol

_NS = 1_000_000_000
_PATIENCE_MS = 2000
_MEDIA: Mapping[type, c.Medium] = {
    SerialLine: c.Medium.SERIAL,
    TcpClient: c.Medium.CLIENT,
    TcpServer: c.Medium.SERVER,
}


def period(hertz: float) -> int:
    """Return the time between two messages at `max_rate`, in ns."""
    return ceil(_NS / hertz)


def framing_of(link: SerialLine | TcpClient | TcpServer) -> c.Framing:
    """Return the framing and checksum of a link, as the carrier executes them."""
    framing, checksum = link.framing, link.checksum
    kind = f"LENGTH_{framing.kind}" if framing.kind in LENGTHS else framing.kind
    of = "CRC32" if framing.kind == "hdlc" else checksum.kind.name if checksum is not None else "NONE"
    is_big_endian = checksum is not None and checksum.is_big_endian
    return c.Framing(c.FramingKind[kind.upper()], c.ChecksumKind[of], is_big_endian, framing.address)


@dataclass(slots=True)
class Openings:
    """Lists the objects to open, as `Image.openings`. The methods that return addresses return symbols."""

    program: CompiledTable
    names: Names
    symbols: Symbols = field(default_factory=Symbols)
    hosts: set[str] = field(default_factory=set)
    listed: dict[Symbol, tuple[Symbol, str, tuple[Any, ...], tuple[Any, ...], bool]] = field(default_factory=dict)

    def _open(
        self, symbol: Symbol, function: str, *arguments: object, of: tuple[object, ...] = (), of_clients: bool = False
    ) -> int:
        self.listed.setdefault(symbol, (symbol, function, arguments, of, of_clients))
        return self.symbols.address(*symbol)

    def _argument(self, *symbol: str | None) -> tuple[int]:
        return (Symbols.number(self.symbols.address(*symbol)),)

    def host(self, host: str) -> int:
        """Return the number of an IP address, and list the address if it is an IPv6 one."""
        if is_ipv6(host):
            self.hosts.add(host)
        return host_number(host)

    def sequence(self, endpoint: str) -> int:
        """Open the sequence that numbers the router's messages for an endpoint."""
        return self._open(("sequence", endpoint), "sequence_open")

    # links

    def link(self, listener: Listener, endpoint: Endpoint) -> int:
        """Open the link to an endpoint at a serial line or TCP connection. It is the sender of the endpoint."""
        link, counters, address = listener.link, self.program.counters, endpoint.address.value
        assert link is not None  # noqa: S101 - checked by the caller
        is_line = isinstance(link, SerialLine)
        settings = c.LinkSettings(
            framing=framing_of(link),
            medium=_MEDIA[type(link)],
            host=0 if is_line else self.host(address.host),
            port=address.port,
            patience=self._patience(endpoint.name),
            endpoint=self.names.number(endpoint.name),
            up=counters.index("link_up", endpoint.name),
            openings=counters.index("link_openings", endpoint.name),
        )
        if isinstance(link, SerialLine):
            settings.line = c.Serial(link.baud, int(c.Parity[link.parity.name]), link.stop_bits)
        return self._open(
            ("sender", endpoint.name),
            "link_open",
            self._argument("timers"),
            bytes(settings),
            link.serial.value.encode() if isinstance(link, SerialLine) else b"",
            self._server(listener) if isinstance(link, TcpServer) else None,
        )

    def _server(self, listener: Listener) -> tuple[int]:
        """Open the TCP server of a listener."""
        host, port = listener.address.value
        refused = self.program.counters.index("datagrams_rejected", listener.name, "source_mismatch")
        of = self.names.number(listener.name), refused
        symbol = "server", listener.name
        self._open(symbol, "server_open", self._argument("timers"), self.host(host), port, *of)
        return self._argument(*symbol)

    def _patience(self, endpoint: str) -> int:
        """Return how long bytes to an endpoint may be unacknowledged (ms): less than its shortest deadman."""
        deadmen = [plan.timeout for plan in self.program.deadmen if endpoint in dict(plan.datagrams)]
        return min([_PATIENCE_MS, *(timeout * 3 // 4 // 1_000_000 for timeout in deadmen)])

    # targets

    def sender(self, endpoint: str) -> int:
        return self.symbols.address("sender", endpoint)

    def replier(self, endpoint: str) -> int:
        """Open the sender of replies to an endpoint, which sends to wherever a datagram came from.

        At the other end of a link, that is the link.
        """
        if isinstance(self.program.table.endpoints[endpoint].address.value, LinkPlace):
            return self.sender(endpoint)
        return self._open(("replier", endpoint), "sender_open", -1, -1, 0, 0)

    def limit(self, plan: RoutePlan, target: Target, source: str | None) -> int:
        """Open the limit of a target with `max_rate` for one source of its route."""
        assert target.declared.max_rate is not None  # noqa: S101 - checked by the caller
        return self._open(
            ("limit", plan.route, plan.topic, source, target.label),
            "limit_open",
            period(target.declared.max_rate),
            of=_plain(target),
        )

    def pacers(self) -> list[int]:
        """Open the pacers of all endpoints with a bandwidth."""
        return [self._pacer(each.name) for each in self.program.senders if each.bandwidth is not None]

    def _pacer(self, endpoint: str) -> int:
        bandwidth = self.program.table.endpoints[endpoint].bandwidth
        return self._open(("pacer", endpoint), "pacer_open", bandwidth, of=(self._argument("sender", endpoint),))

    def deferral(self, plan: RoutePlan, target: Target, source: str | None) -> int:
        """Open what holds back messages of a source for a target.

        It is passed on as long as the destination is the same, and what is filled in its messages when they are sent.
        """
        symbol = "deferral", plan.route, plan.topic, source, target.label
        if target.is_topic:
            (topic,) = (each for each in self.program.publishers if each.label == target.label)
            return self._open(symbol, "deferral_open", None, of=_settings(topic))
        filled = _filled(target.beside)
        if self.program.table.endpoints[target.label].bandwidth is None:
            return self._open(symbol, "deferral_open", None, of=(self._argument("sender", target.label), filled))
        self._pacer(target.label)
        return self._open(symbol, "deferral_open", self._argument("pacer", target.label), of=(filled,))

    def order(self, route: str) -> int:
        """Open the numbers of the senders of a route, as long as they are numbers of the same kind."""
        (declared,) = (each.order for each in self.program.table.routes if each.name == route)
        return self._open(("order", route), "order_state_open", of=(str(declared), self.program.protos_sha256))

    def collector(self, plan: RoutePlan) -> int:
        """Open the collector that makes frames of the route's payload for its topics."""
        topics = tuple(_plain(target) for target in plan.targets if target.is_topic)
        payload = plan.case.name if plan.case else "", self.program.protos_sha256
        return self._open(("collector", plan.route), "collector_open", plan.collect_timeout, of=(*payload, *topics))

    def state(self, plan: StatePlan) -> int:
        """Open a state, which keeps its value as long as it has the same type."""
        return self._open(("state", plan.name), "state_open", of=(plan.type,))

    # deadmen

    def deadman(self, plan: DeadmanPlan) -> int:
        """Open the deadman of a route."""
        for endpoint, beside in plan.beside.items():
            if beside.changing:
                self.sequence(endpoint)
        return self._open(("deadman", plan.route), "deadman_open", *self._deadman(plan, "timers", "sender"))

    def client_deadman(self, plan: DeadmanPlan) -> int:
        """Open the deadman of a topic that clients of a gateway may publish on."""
        arguments = self._deadman(plan, "client timers", "publisher")
        return self._open(("client deadman", plan.route), "deadman_open", *arguments, of_clients=True)

    def _deadman(self, plan: DeadmanPlan, group: str, kind: str) -> Iterator[object]:
        yield self._argument(group)
        yield from deadman_arguments(plan, self.program.counters, self.names, kind, self._argument)

    def feed(self, route: str, endpoint: str, *, disarms: bool) -> c.Feed:
        """Return the effect of commands to an endpoint on the deadman of a route."""
        (plan,) = (each for each in self.program.deadmen if each.route == route)
        return feed_of(plan, self.deadman(plan), endpoint, disarms=disarms)

    def holding(self, route: str, endpoint: str) -> list[int]:
        """Open the deferrals that hold commands of a route to an endpoint."""
        return [
            self.deferral(plan, target, source)
            for plan in self.program.routes
            if plan.route == route
            for target in plan.targets
            if target.label == endpoint and target.is_deferred and not target.is_topic
            for source in sources_of(plan)
        ]


def sources_of(plan: RoutePlan) -> Collection[str | None]:
    """Return the sources of a route; None stands for all publishers of a topic, or for unknown senders."""
    return [None] if plan.topic is not None else sorted(plan.sources, key=str)


def deadman_arguments(
    plan: DeadmanPlan, counters: Counters, names: Names, kind: str, argument: Callable[[str, str], object]
) -> Iterator[object]:
    """Yield the arguments of `deadman_open` behind the group, with the destinations as one argument.

    `argument` returns what stands for the sender or publisher (`kind`) of a destination.
    """
    yield from (plan.timeout, plan.repeat, plan.at_start)
    yield counters.index("deadman_active", plan.route)
    yield counters.index("deadman_trips", plan.route)
    yield names.number(plan.route)
    yield tuple(
        (
            kind,
            argument(kind, name),
            datagrams,
            counters.index("deadman_datagrams_sent", plan.route, name),
            counters.index("deadman_send_errors", plan.route, name),
            names.number(name),
            name in plan.following,
            *((True, counters.index("endpoint_silence_seconds", name)) if kind == "sender" else (False, 0)),
            *_obeyed(plan, name, counters),
            *_beside(plan.beside.get(name), name, argument),
        )
        for name, datagrams in plan.datagrams
    )


def feed_of(plan: DeadmanPlan, deadman: int, endpoint: str, *, disarms: bool) -> c.Feed:
    """Return the effect on a deadman, by its address, of each command to an endpoint.

    A command to an endpoint that the deadman does not send to arms all that it sends to.
    """
    endpoints = [name for name, _ in plan.datagrams]
    armed = [endpoint] if endpoint in endpoints else endpoints
    return c.Feed(deadman=deadman, to=sum(1 << endpoints.index(each) for each in armed), disarms=disarms)


def _obeyed(plan: DeadmanPlan, name: str, counters: Counters) -> tuple[int, int, int]:
    """Return within which time a destination must obey (ns; 0: unknown), and the counters for that."""
    if plan.obeyed is None or name not in plan.obeyed.endpoints:
        return 0, 0, 0
    disobeyed = counters.index("deadman_disobeyed", plan.route, name)
    return plan.obeyed.within, disobeyed, counters.index("deadman_stopping_seconds", plan.route, name)


def _beside(beside: Beside | None, endpoint: str, argument: Callable[[str, str], object]) -> tuple[object, object]:
    """Return the sequence of an endpoint, None if nothing is filled in its messages, and what is filled in them."""
    filled = _filled(beside)
    return argument("sequence", endpoint) if filled else None, filled


def _filled(beside: Beside | None) -> tuple[tuple[int | float, ...], ...]:
    """Return what is filled in messages when they are sent, as plain values."""
    return tuple(each.members for each in beside.changing) if beside else ()


def _settings(topic: TopicPlan) -> tuple[object, ...]:
    """Return the settings of a topic, which determine its publisher, as plain values."""
    return (topic.topic, topic.type_name, *astuple(topic.qos), *sorted(topic.definitions.items()))


def _plain(target: Target) -> tuple[object, ...]:
    """Return the settings of a target as plain values."""
    flags = target.is_topic, target.is_deferred, target.is_command
    declared = target.declared
    return (target.label, declared.max_rate, declared.on_limit.name, target.priority.name, *flags, *target.deadmen)
