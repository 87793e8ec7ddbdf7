"""Turns a compiled table into the arrays that the carrier executes.

The compiler has decided everything; here names become indexes, and addresses of what is open.
"""

from __future__ import annotations

import ctypes
import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from router.carrier import structures as c
from router.carrier.boards import NativeBoards
from router.carrier.schema import wire_schema
from router.compiler.metrics import REJECT_REASONS, UNKNOWN_CASE, Counters
from router.compiler.network import recognisers
from router.compiler.program import STRANGER, Handler, Program, TargetPlan, source_label
from router.net.udp import Listener
from router.table.model import Framing


class Names:
    """Numbers for names, in both directions. A name keeps its number as long as the process lives."""

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}
        self._names: list[str] = []

    def number(self, name: str) -> int:
        if name not in self._numbers:
            self._numbers[name] = len(self._names)
            self._names.append(name)
        return self._numbers[name]

    def name(self, number: int) -> str:
        return self._names[number]


@dataclass(frozen=True, slots=True)
class PartTargets:
    """The targets of a route that one thread serves, and the ring by which it gets the messages.

    `publishes` is what the native thread does with them, None for a thread of Python.
    """

    ring: int
    targets: Sequence[TargetPlan]
    is_always_wanted: bool
    publishes: c.PublishRoute | None = None


@dataclass(frozen=True, slots=True)
class Outlets:
    """What is open for a program. Pointers are addresses of C structures.

    `senders` are by endpoint, `wanted` by topic. `feeds(route, names)` returns the deadmen that a command feeds
    (False) or disarms (True), `limit(handler, target)` the limit of a target with `max_rate`. `carried(handler)` are
    the targets that the carrier serves, `parts(handler)` all others. Without
    `boards`, endpoints that are boards get everything.
    """

    listeners: Mapping[str, Listener]
    senders: Mapping[str, int]
    wanted: Mapping[str, ctypes.Array[Any]]
    feeds: Callable[[str, Sequence[str]], Sequence[tuple[int, bool]]]
    limit: Callable[[Handler, TargetPlan], c.Limit]
    carried: Callable[[Handler], Sequence[TargetPlan]]
    parts: Callable[[Handler], Sequence[PartTargets]]
    names: Names
    boards: NativeBoards | None = None


@dataclass(slots=True)
class NativeProgram:
    """`struct program` with all that it refers to. `handlers` by their number in messages for Python."""

    generation: int
    handlers: Sequence[Handler]
    sources: Sequence[str]
    """The `source` label of each column."""
    arrays: list[object] = field(default_factory=list)
    structure: c.Program = field(default_factory=c.Program)


def native_program(program: Program, generation: int, outlets: Outlets) -> NativeProgram:
    """Make the arrays of a program; `generation` numbers the programs of the process. Raises CannotCarry."""
    schema = wire_schema(program.envelope, program.inbound.keys())
    handlers = [handler for several in program.inbound.values() for handler in several]
    endpoints = list(program.table.endpoints)
    made = NativeProgram(generation, handlers, [*endpoints, source_label(STRANGER)], [schema])
    writer = _Writer(program, made, outlets, {name: column for column, name in enumerate(endpoints)})
    made.structure = c.Program(
        generation=generation,
        listener_count=len(program.listeners),
        case_count=len(program.envelope.cases),
        unknown_case=program.counters.index("unhandled", UNKNOWN_CASE),
        schema=ctypes.addressof(schema.schema),
        listeners=writer.array(c.Listener, writer.listeners()),
        cases=writer.array(c.Case, writer.cases()),
        routes=writer.array(c.Route, [writer.route(number, handler) for number, handler in enumerate(handlers)]),
    )
    return made


@dataclass(frozen=True, slots=True)
class _Writer:
    program: Program
    made: NativeProgram
    outlets: Outlets
    columns: Mapping[str, int]

    @property
    def counters(self) -> Counters:
        return self.program.counters

    def array(self, kind: Any, elements: Sequence[Any]) -> Any:
        """An array that lives as long as the program; NULL for none."""
        if not elements:
            return None
        made = (kind * len(elements))(*elements)
        self.made.arrays.append(made)
        return made

    # senders and payload cases

    def cases(self) -> list[c.Case]:
        cases = sorted(self.program.envelope.cases.values(), key=lambda case: case.number)
        rows = {number: row for row, number in enumerate(self.program.inbound)}
        return [
            c.Case(
                number=case.number,
                row=rows.get(case.number, -1),
                is_ignored=case.number in self.program.ignored,
                unhandled=self.counters.index("unhandled", case.name),
            )
            for case in cases
        ]

    def listeners(self) -> list[c.Listener]:
        return [self._listener(plan.name, plan.framing) for plan in self.program.listeners]

    def _listener(self, name: str, framing: Framing) -> c.Listener:
        opened, counters = self.outlets.listeners[name], self.counters
        peers = list(self._peers(name))
        rejected = [counters.index("datagrams_rejected", name, reason) for reason in REJECT_REASONS]
        return c.Listener(
            fd=opened.socket.fileno(),
            id=self.outlets.names.number(name),
            repairs=framing is Framing.ZERO_TRIMMED,
            keeps_input=opened.is_inherited,
            peers=self.array(c.Peer, peers),
            entries=self.array(c.Entry, list(self._entries())),
            peer_count=len(peers),
            columns=len(self.made.sources),
            received=counters.index("datagrams_received", name),
            received_bytes=counters.index("received_bytes", name),
            padded=counters.index("datagrams_padded", name),
            rejected=(ctypes.c_uint32 * c.REASONS)(*rejected),
        )

    def _peers(self, listener: str) -> Iterator[c.Peer]:
        """By address; those with a port first, as they are preferred."""
        by_host, by_address = recognisers(self.program.table.endpoints, listener)
        known = [(host, port, name) for (host, port), name in by_address.items()]
        known += [(host, 0, name) for host, name in by_host.items()]
        for address, _, port, name in sorted((_number(host), not port, port, name) for host, port, name in known):
            last_seen = self.counters.index("endpoint_last_seen_timestamp_seconds", name)
            number = self.outlets.names.number(name)
            yield c.Peer(address=address, port=port, column=self.columns[name], last_seen=last_seen, id=number)

    def _entries(self) -> Iterator[c.Entry]:
        """Row by row, as in `cases`: a column for each endpoint, and the last one for strangers."""
        numbers = {handler.route: number for number, handler in enumerate(self.made.handlers)}
        for handlers in self.program.inbound.values():
            by_source = {source: handler for handler in handlers for source in handler.sources}
            stranger = self._entry(numbers, by_source.get(STRANGER), STRANGER)
            for name in self.columns:
                found = by_source.get(name)
                yield self._entry(numbers, found, name) if found else stranger
            yield stranger

    def _entry(self, numbers: Mapping[str, int], handler: Handler | None, source: str | None) -> c.Entry:
        if handler is None:
            return c.Entry(route=-1)
        received = self.counters.index("messages_received", handler.route, source_label(source))
        return c.Entry(route=numbers[handler.route], received=received)

    # routes

    def route(self, number: int, handler: Handler) -> c.Route:
        arrays = self.made.arrays
        destinations = [
            native_destination(self.program, self.outlets, arrays, handler, target)
            for target in self.outlets.carried(handler)
        ]
        parts = [self._part(number, handler, part) for part in self.outlets.parts(handler)]
        return c.Route(
            ttl=handler.ttl or 0,
            destinations=self.array(c.Destination, destinations),
            parts=self.array(c.Part, parts),
            destination_count=len(destinations),
            part_count=len(parts),
            id=self.outlets.names.number(handler.route),
            last_message=self.counters.index("route_last_message_timestamp_seconds", handler.route),
            duration=self.counters.index("route_duration_seconds", handler.route),
        )

    def _part(self, number: int, handler: Handler, part: PartTargets) -> c.Part:
        topics = [self.outlets.wanted[target.label] for target in part.targets if target.is_topic]
        flags = [ctypes.addressof(flag) for flag in topics]
        self.made.arrays.append(topics)
        targets = [self._waiting(handler, target) for target in part.targets]
        return c.Part(
            ring=part.ring,
            publishes=ctypes.pointer(part.publishes) if part.publishes is not None else None,
            wanted=self.array(ctypes.c_void_p, flags),
            targets=self.array(c.Waiting, targets),
            wanted_count=len(flags),
            target_count=len(targets),
            is_always_wanted=part.is_always_wanted,
            handler=number,
            route=self.outlets.names.number(handler.route),
        )

    def _waiting(self, handler: Handler, target: TargetPlan) -> c.Waiting:
        counters, place = self.counters, (handler.route, target.label)
        return c.Waiting(
            id=self.outlets.names.number(target.label),
            waiting=counters.index("messages_waiting", *place),
            queue_full=counters.index("messages_dropped", *place, "queue_full"),
            filtered=counters.index("messages_filtered", *place),
        )


def native_destination(
    program: Program, outlets: Outlets, arrays: list[object], handler: Handler, target: TargetPlan
) -> c.Destination:
    """A target that the carrier serves. `arrays` gets what has to live as long."""
    counters, place = program.counters, (handler.route, target.label)
    made = c.Destination(
        sender=outlets.senders[target.label],
        trims=program.table.endpoints[target.label].trim_trailing_zeros,
        id=outlets.names.number(target.label),
        sent=counters.index("datagrams_sent", *place),
        sent_bytes=counters.index("sent_bytes", *place),
        stale=counters.index("messages_dropped", *place, "stale"),
        rate_limited=counters.index("messages_dropped", *place, "rate_limited"),
        send_buffer_full=counters.index("messages_dropped", *place, "send_buffer_full"),
        send_error=counters.index("messages_dropped", *place, "send_error"),
        too_large=counters.index("messages_dropped", *place, "too_large"),
        non_finite=counters.index("messages_dropped", *place, "non_finite"),
    )
    if outlets.boards is not None:
        made.board = outlets.boards.pointer(target.label)
        arrays.append(outlets.boards)
    if target.deadmen:
        feeds = [
            c.Feed(deadman=deadman, disarms=disarms)
            for deadman, disarms in outlets.feeds(handler.route, target.deadmen)
        ]
        made.feeds, made.feed_count = (c.Feed * len(feeds))(*feeds), len(feeds)
        arrays.append(made.feeds)
    if target.max_rate is not None:
        limit = outlets.limit(handler, target)
        made.limit = ctypes.pointer(limit)
        arrays.append(limit)
    return made


def _number(host: str) -> int:
    return int.from_bytes(socket.inet_aton(host), "big")
