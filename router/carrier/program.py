"""Turns a compiled table into the arrays that the carrier executes.

The compiler has decided everything; here names become indexes, and addresses of what is open.
"""

from __future__ import annotations

import ctypes
import socket
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from router.carrier import structures as c
from router.carrier.deferrals import Adoption
from router.carrier.outlets import Outlets, PartTargets
from router.carrier.schema import wire_schema
from router.carrier.targets import TargetWriter
from router.compiler.metrics import REJECT_REASONS, UNKNOWN_CASE, Counters
from router.compiler.network import recognisers
from router.compiler.program import STRANGER, Handler, Program, TargetPlan, source_label
from router.table.model import Framing


@dataclass(slots=True)
class NativeProgram:
    """`struct program` with all that it refers to. `handlers` by their number in messages for Python.

    `adopted` are the deferrals of its targets.
    """

    generation: int
    handlers: Sequence[Handler]
    sources: Sequence[str]
    """The `source` label of each column."""
    adopted: Sequence[Adoption] = ()
    arrays: list[object] = field(default_factory=list)
    structure: c.Program = field(default_factory=c.Program)


def native_program(program: Program, generation: int, outlets: Outlets) -> NativeProgram:
    """Make the arrays of a program; `generation` numbers the programs of the process. Raises CannotCarry."""
    schema = wire_schema(program.envelope, program.inbound.keys())
    handlers = [handler for several in program.inbound.values() for handler in several]
    endpoints = list(program.table.endpoints)
    made = NativeProgram(generation, handlers, [*endpoints, source_label(STRANGER)], arrays=[schema])
    targets = TargetWriter(program, outlets, generation, made.arrays)
    writer = _Writer(program, made, outlets, targets, {name: column for column, name in enumerate(endpoints)})
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
    made.adopted = targets.adopted
    return made


@dataclass(frozen=True, slots=True)
class _Writer:
    program: Program
    made: NativeProgram
    outlets: Outlets
    targets: TargetWriter
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
        parts = [self._part(number, handler, part) for part in self.outlets.parts(handler)]
        conditions = self.program.lowered.conditions.get(handler.route)
        return c.Route(
            sends=self.targets.of_datagrams(handler, self.outlets.carried(handler), conditions),
            parts=self.array(c.Part, parts),
            part_count=len(parts),
            last_message=self.counters.index("route_last_message_timestamp_seconds", handler.route),
            duration=self.counters.index("route_duration_seconds", handler.route),
        )

    def _part(self, number: int, handler: Handler, part: PartTargets) -> c.Part:
        topics = [self.outlets.publications[target.label].wanted for target in part.targets if target.is_topic]
        flags = [ctypes.addressof(flag) for flag in topics]
        self.made.arrays.append(topics)
        targets = [self._waiting(handler, target) for target in part.targets]
        return c.Part(
            ring=part.ring,
            publishes=ctypes.pointer(self._published(handler, part)) if part.is_native else None,
            wanted=self.array(ctypes.c_void_p, flags),
            targets=self.array(c.Waiting, targets),
            wanted_count=len(flags),
            target_count=len(targets),
            is_always_wanted=part.is_always_wanted,
            handler=number,
            route=self.outlets.names.number(handler.route),
        )

    def _published(self, handler: Handler, part: PartTargets) -> c.Targets:
        return self.targets.of_datagrams(handler, part.targets, self.program.lowered.topics[handler.route])

    def _waiting(self, handler: Handler, target: TargetPlan) -> c.Waiting:
        counters, place = self.counters, (handler.route, target.label)
        return c.Waiting(
            id=self.outlets.names.number(target.label),
            waiting=counters.index("messages_waiting", *place),
            queue_full=counters.index("messages_dropped", *place, "queue_full"),
            filtered=counters.index("messages_filtered", *place),
        )


def _number(host: str) -> int:
    return int.from_bytes(socket.inet_aton(host), "big")
