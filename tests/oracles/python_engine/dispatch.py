"""From a received datagram or ROS message to its handlers, or to the counter of the reason why there is none."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import FunctionType

from google.protobuf.message import DecodeError as ProtobufError
from google.protobuf.message import Message

from router.compiler import STRANGER, source_label
from router.compiler.metrics import HISTOGRAM_BOUNDS_NS, HISTOGRAM_CELLS, REJECT_REASONS, Report
from router.compiler.network import recognisers
from router.compiler.program import Program, RoutePlan
from router.datagrams import Peer
from router.declared import MAX_DATAGRAM
from router.types.wire import LEN
from tests.oracles.python_engine.binding import EngineContext, Handle, bind, unbind
from tests.oracles.python_engine.freshness import Born, Freshness
from tests.oracles.python_engine.slow_path import Rejected, SlowPath

Receive = Callable[[bytes, Peer], str]
"""Takes a datagram, and returns why no route took it: one of REJECT_REASONS, "" if one did."""

Take = Callable[[bytes, int, bool], None]

_Addresses = Sequence[tuple[object, str]]
"""Keys by which endpoints are recognised (IP address, or IP address and port), each with the endpoint's name."""
_SUM = HISTOGRAM_CELLS - 1


@dataclass(frozen=True, slots=True)
class _Route:
    """A route for one of its senders: the indexes of its counters, and the sender's name in expressions."""

    received: int
    name: str
    handle: Handle
    last_message: int
    seconds: int


@dataclass(frozen=True, slots=True)
class _Case:
    """A payload case. `routes` is by IP address, or by (IP address, port)."""

    name: str
    parse: Callable[[bytes], Message]
    routes: Mapping[object, _Route]
    stranger: _Route | None


class InboundEngine:
    """A program's routes from UDP.

    `arrived_at`, by listener, returns when the kernel got the datagram that was last received (wall clock, ns).
    `freshness` belongs to the thread that receives, and outlives programs.
    """

    def __init__(
        self,
        program: Program,
        context: EngineContext,
        arrived_at: Mapping[str, Callable[[], int]],
        freshness: Freshness,
    ) -> None:
        self._program = program
        self._context = context
        self._counts = context.counts
        self._arrived_at = arrived_at
        self._freshness = freshness
        self._handles = {
            handler.route: bind(program, handler, context, self._freshness)
            for handlers in program.inbound.values()
            for handler in handlers
        }

    def close(self) -> None:
        """Free the handlers. No receiver may be called afterwards."""
        for handle in self._handles.values():
            unbind(handle)

    def receiver(self, listener: str) -> Receive:
        """Return the function that takes the datagrams of one listener. It never raises for what was received.

        This is the hot path: everything it needs is a local name, and the usual datagram (one payload,
        complete, of a routed case, from its endpoint) goes straight through.
        """
        counters, counts = self._program.counters, self._counts
        # An endpoint that is believed only by another listener is a stranger here.
        by_host, by_address = recognisers(self._program.table.endpoints, listener)
        addresses: _Addresses = [*by_host.items(), *by_address.items()]
        cases = self._cases(listener, addresses)
        # Cases whose tag is at most two bytes long.
        by_tag = {number << 3 | LEN: case for number, case in cases.items() if number < 2048}
        clock_ns, wall_ns, bounds = self._context.clock_ns, self._context.wall_ns, HISTOGRAM_BOUNDS_NS
        look = self._freshness.look
        received, received_bytes = (
            counters.index("datagrams_received", listener),
            counters.index("received_bytes", listener),
        )
        seen = self._seen_indexes(addresses)
        parse_slowly, reject = SlowPath(self._program, counts, listener, cases).parse, self._rejecter(listener)

        def receive(data: bytes, peer: Peer) -> str:
            now = clock_ns()
            received_at = wall_ns()
            look(received_at, now)
            size = len(data)
            counts[received] += 1
            counts[received_bytes] += size
            sender_key = peer if by_address and peer in by_address else peer[0]
            if sender_key in seen:
                counts[seen[sender_key]] = received_at
            try:
                tag, start = data[0], 1
                if tag > 0x7F:
                    tag, start = tag & 0x7F | data[1] << 7, 2
                length, start = data[start], start + 1
                if length > 0x7F:
                    length, start = length & 0x7F | data[start] << 7, start + 1
                case = by_tag[tag]
                if start + length != size or size > MAX_DATAGRAM:
                    raise LookupError
                message = case.parse(data[start:])
            except (LookupError, ProtobufError):  # not the usual datagram
                try:
                    case, message, data = parse_slowly(data)
                except Rejected as rejected:
                    reject(rejected.reason, peer, str(rejected))
                    return rejected.reason
            route = case.routes.get(sender_key, case.stranger)
            if route is None:
                reject("source_mismatch", peer, case.name)
                return "source_mismatch"
            counts[route.received] += 1
            route.handle(message, data, received_at, now, route.name)
            counts[route.last_message] = received_at
            elapsed = clock_ns() - now
            counts[route.seconds + bisect_left(bounds, elapsed)] += 1
            counts[route.seconds + _SUM] += elapsed
            return ""

        return receive

    def _cases(self, listener: str, addresses: _Addresses) -> dict[int, _Case]:
        """The cases with a route, by field number."""
        inbound = self._program.inbound
        return {number: self._case(handlers, listener, addresses) for number, handlers in inbound.items()}

    def _case(self, handlers: Sequence[RoutePlan], listener: str, addresses: _Addresses) -> _Case:
        by_source = {
            source: self._route(handler, source, listener) for handler in handlers for source in handler.sources
        }
        return _Case(
            name=handlers[0].case.name,
            parse=handlers[0].case.message_class.FromString,
            routes={key: by_source[name] for key, name in addresses if name in by_source},
            stranger=by_source.get(STRANGER),
        )

    def _route(self, handler: RoutePlan, source: str | None, listener: str) -> _Route:
        counters, label = self._program.counters, source_label(source)
        handle = self._handles[handler.route]
        return _Route(
            received=counters.index("messages_received", handler.route, label),
            name=label,
            handle=handle if handler.ttl is None else self._aged(handle, self._arrived_at[listener]),
            last_message=counters.index("route_last_message_timestamp_seconds", handler.route),
            seconds=counters.index("route_duration_seconds", handler.route),
        )

    def _aged(self, handle: Handle, arrived_at: Callable[[], int]) -> Handle:
        """The handler of a route with a `ttl`: the time that a datagram waited in the socket counts too."""
        born = self._freshness.born

        def aged(message: Message, data: bytes, received_at: int, now: int, source: str) -> None:
            handle(message, data, received_at, now, source, born(arrived_at(), received_at, now))

        return aged

    def _seen_indexes(self, addresses: _Addresses) -> dict[object, int]:
        metric = "endpoint_last_seen_timestamp_seconds"
        return {key: self._program.counters.index(metric, name) for key, name in addresses}

    def _rejecter(self, listener: str) -> Callable[[str, Peer, str], None]:
        counters, counts, report = self._program.counters, self._counts, self._context.report
        indexes = {reason: counters.index("datagrams_rejected", listener, reason) for reason in REJECT_REASONS}

        def reject(reason: str, peer: Peer, what: str) -> None:
            counts[indexes[reason]] += 1
            if reason != "ignored":
                detail = f"from {peer[0]}:{peer[1]}" + (f": {what}" if what else "")
                report(Report("reject", listener, "", reason, None, detail))

        return reject


@dataclass(frozen=True, slots=True)
class _OutboundRoute:
    handle: Handle
    is_aged: bool
    last_message: int
    seconds: int


class OutboundEngine:
    """A program's routes from ROS. `freshness` belongs to the thread that takes messages, and outlives programs."""

    def __init__(self, program: Program, context: EngineContext, freshness: Freshness) -> None:
        self._program = program
        self._context = context
        self._handles: list[FunctionType] = []
        self._freshness = freshness

    def close(self) -> None:
        """Free the handlers. No taker may be called afterwards."""
        for handle in self._handles:
            unbind(handle)

    def taker(self, topic: str) -> Take:
        """Return the function that takes one topic's messages. It never raises for what was received.

        Its arguments are CDR bytes, when the message set out (wall clock, ns), and whether it is known to come after
        the topic's last one.
        """
        routes = [self._route(handler) for handler in self._program.outbound[topic]]
        counts, bounds, total = self._context.counts, HISTOGRAM_BOUNDS_NS, _SUM
        clock_ns, wall_ns, born = self._context.clock_ns, self._context.wall_ns, self._freshness.born

        is_aged = any(route.is_aged for route in routes)
        last = Born(0, 0)

        def take(cdr: bytes, sent_at: int, follows: bool) -> None:
            nonlocal last
            now = clock_ns()
            received_at = wall_ns()
            if is_aged:
                last = born(sent_at, received_at, now, last.oldest if follows else None)
            for route in routes:
                if route.is_aged:
                    route.handle(cdr, received_at, now, topic, last)
                else:
                    route.handle(cdr, received_at, now, topic)
                counts[route.last_message] = received_at
                elapsed = clock_ns() - now
                counts[route.seconds + bisect_left(bounds, elapsed)] += 1
                counts[route.seconds + total] += elapsed

        return take

    def _route(self, handler: RoutePlan) -> _OutboundRoute:
        counters = self._program.counters
        self._handles.append(handle := bind(self._program, handler, self._context, self._freshness))
        return _OutboundRoute(
            handle=handle,
            is_aged=handler.ttl is not None,
            last_message=counters.index("route_last_message_timestamp_seconds", handler.route),
            seconds=counters.index("route_duration_seconds", handler.route),
        )
