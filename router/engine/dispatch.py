"""From a datagram to the handler of its payload case, or to the counter that says why there is none."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from google.protobuf.message import DecodeError as ProtobufError
from google.protobuf.message import Message

from router.compiler import STRANGER, source_label
from router.compiler.books import HISTOGRAM_BOUNDS_NS, HISTOGRAM_SLOTS, REJECT_REASONS, UNKNOWN_CASE
from router.compiler.network import recognisers
from router.compiler.program import Handler, Program
from router.engine.binding import Handle, Outlets, bind
from router.engine.framing import LEN, restored
from router.engine.outcome import Report
from router.engine.payloadless import why_no_payload
from router.table.model import Framing

MAX_DATAGRAM = 16 * 1024
"""The longest datagram, in bytes, that is looked at; a longer one is rejected as `truncated`."""

Peer = tuple[str, int]
Receive = Callable[[bytes, Peer], None]
_SUM = HISTOGRAM_SLOTS - 1


@dataclass(frozen=True, slots=True)
class _Sender:
    """How one sender of a route is counted, and called in expressions."""

    slot: int
    name: str


@dataclass(frozen=True, slots=True)
class _Route:
    """What dispatch needs of a route. `senders` is by whatever `Engine._key` makes of an address."""

    case: str
    parse: Callable[[bytes], Message]
    handle: Handle
    senders: Mapping[object, _Sender]
    stranger: _Sender | None
    last_message: int
    seconds: int


class _Rejected(Exception):
    def __init__(self, reason: str, detail: str = "") -> None:
        super().__init__(detail)
        self.reason = reason


class Engine:
    """A program bound to the outside world.

    `send` takes a datagram, by endpoint name, and may raise OSError. `publish` takes CDR bytes, by topic,
    and may raise `publish_errors`. `wanted` says by topic whether anybody listens, in a list of one that
    its owner keeps up to date. `report` hears of every loss; it is called only for those. Clocks in ns.
    """

    def __init__(
        self,
        program: Program,
        counts: list[int],
        send: Mapping[str, Callable[[bytes], int]],
        publish: Mapping[str, Callable[[bytes], None]],
        wanted: Mapping[str, list[bool]],
        report: Callable[[Report], None],
        clock_ns: Callable[[], int],
        wall_ns: Callable[[], int],
        publish_errors: tuple[type[Exception], ...] = (),
    ) -> None:
        self._program = program
        self._counts = counts
        self._report = report
        self._clock_ns = clock_ns
        self._wall_ns = wall_ns
        self._case_numbers = frozenset(case.number for case in program.envelope.cases.values())
        self._by_host, self._by_address = recognisers(program.table.endpoints)
        outlets = Outlets(counts, send, publish, wanted, report, publish_errors)
        self._routes = {
            number: self._route(handler, bind(handler, program.books, outlets))
            for number, [handler] in program.inbound.items()
        }

    def _route(self, handler: Handler, handle: Handle) -> _Route:
        books, case = self._program.books, handler.case.name
        senders = {
            source: _Sender(books.slot("messages_received", case, source_label(source)), source_label(source))
            for source in handler.sources
        }
        addresses: list[tuple[object, str]] = [*self._by_host.items(), *self._by_address.items()]
        return _Route(
            case=case,
            parse=handler.case.message_class.FromString,
            handle=handle,
            senders={key: senders[name] for key, name in addresses if name in senders},
            stranger=senders.get(STRANGER),
            last_message=books.slot("route_last_message_timestamp_seconds", case),
            seconds=books.slot("route_seconds", case),
        )

    def receiver(self, listener: str) -> Receive:
        """The function that takes the datagrams of one listener. It never raises for what was received.

        This is the hot path: everything it needs is a local name, and the usual datagram (one payload,
        complete, of a routed case, from its endpoint) goes straight through.
        """
        books, counts = self._program.books, self._counts
        # By tag, of those whose tag is two bytes at most.
        routes = {number << 3 | LEN: route for number, route in self._routes.items() if number < 2048}
        clock_ns, wall_ns, bounds = self._clock_ns, self._wall_ns, HISTOGRAM_BOUNDS_NS
        received, received_bytes = books.slot("datagrams_received", listener), books.slot("received_bytes", listener)
        seen = self._seen_slots()
        by_address = self._by_address
        settle, reject = self._settler(listener), self._rejecter(listener)

        def receive(data: bytes, peer: Peer) -> None:
            now = clock_ns()
            received_at = wall_ns()
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
                route = routes[tag]
                if start + length != size or size > MAX_DATAGRAM:
                    raise LookupError
                message = route.parse(data[start:])
            except (LookupError, ProtobufError):  # not the usual datagram
                try:
                    route, message = settle(data)
                except _Rejected as rejected:
                    reject(rejected.reason, peer, str(rejected))
                    return
            sender = route.senders.get(sender_key, route.stranger)
            if sender is None:
                reject("source_mismatch", peer, route.case)
                return
            counts[sender.slot] += 1
            route.handle(message, data, received_at, now, sender.name)
            counts[route.last_message] = received_at
            elapsed = clock_ns() - now
            counts[route.seconds + bisect_left(bounds, elapsed)] += 1
            counts[route.seconds + _SUM] += elapsed

        return receive

    def _seen_slots(self) -> dict[object, int]:
        addresses: list[tuple[object, str]] = [*self._by_host.items(), *self._by_address.items()]
        metric = "endpoint_last_seen_timestamp_seconds"
        return {key: self._program.books.slot(metric, name) for key, name in addresses}

    def _settler(self, listener: str) -> Callable[[bytes], tuple[_Route, Message]]:
        """The unusual datagram: repaired if the listener's framing says so, then read by the protobuf library."""
        plan = next(plan for plan in self._program.listeners if plan.name == listener)
        repairs = plan.framing is Framing.ZERO_TRIMMED
        padded = self._program.books.slot("datagrams_padded", listener)
        counts, parse = self._counts, self._program.envelope.message_class.FromString

        def settle(data: bytes) -> tuple[_Route, Message]:
            if len(data) > MAX_DATAGRAM:
                raise _Rejected("truncated", f"{len(data)} bytes")
            if not data:
                raise _Rejected("empty")
            whole = restored(data, MAX_DATAGRAM) if repairs else data
            try:
                envelope = parse(whole)
            except ProtobufError as error:
                raise _Rejected("malformed", str(error)) from error
            if len(whole) != len(data):
                counts[padded] += 1
            return self._find(envelope)

        return settle

    def _find(self, message: Message) -> tuple[_Route, Message]:
        """The route and the payload of a parsed envelope, whatever else is in it. Raises _Rejected."""
        envelope = self._program.envelope
        case = message.WhichOneof(envelope.oneof)
        if case is None:
            reason, detail = why_no_payload(message, self._case_numbers)
            if reason == "unknown_case":
                self._count_unhandled(UNKNOWN_CASE)
            raise _Rejected(reason, detail)
        number = envelope.cases[case].number
        route = self._routes.get(number)
        if route is not None:
            return route, getattr(message, case)
        if number in self._program.ignored:
            raise _Rejected("ignored", case)
        self._count_unhandled(case)
        raise _Rejected("unhandled", case)

    def _count_unhandled(self, case: str) -> None:
        self._counts[self._program.books.slot("unhandled", case)] += 1

    def _rejecter(self, listener: str) -> Callable[[str, Peer, str], None]:
        books, counts, report = self._program.books, self._counts, self._report
        slots = {reason: books.slot("datagrams_rejected", listener, reason) for reason in REJECT_REASONS}

        def reject(reason: str, peer: Peer, what: str) -> None:
            counts[slots[reason]] += 1
            if reason != "ignored":
                detail = f"from {peer[0]}:{peer[1]}" + (f": {what}" if what else "")
                report(Report("reject", listener, "", reason, None, detail))

        return reject
