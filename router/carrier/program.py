"""Turns a compiled table into the arrays that the carrier executes.

The compiler has decided everything; here names become indexes and addresses of open objects.
"""

from __future__ import annotations

import ctypes
import socket
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from router import declared as c
from router.carrier.deadmen import NativeDeadman
from router.carrier.outlets import Outlets
from router.carrier.reasons import REJECTIONS
from router.carrier.schema import wire_schema
from router.carrier.targets import TargetStates, TargetWriter
from router.compiler.lowering.arrays import Arrays
from router.compiler.lowering.routines import Routines
from router.compiler.metrics import ENDPOINT_METRICS, UNKNOWN_CASE, Counters
from router.compiler.network import recognisers
from router.compiler.program import STRANGER, Program, RoutePlan, source_label
from router.table.model import Endpoint, Framing


def _pause(endpoint: Endpoint) -> int:
    """Return the longest pause (ns) between two datagrams that is no silence.

    `stale_after` is the time after which silence is a problem. By default it is 5 s, and a board that is reset takes
    about 2 s: so 2/5 of it. An endpoint that is never stale has no silences.
    """
    return c.NEVER if endpoint.stale_after is None else endpoint.stale_after * 2 // 5


@dataclass(slots=True)
class NativeProgram:
    """`struct program` with everything that it points to."""

    generation: int
    states: TargetStates = field(default_factory=TargetStates)
    arrays: Arrays = field(default_factory=Arrays)
    structure: c.Program = field(default_factory=c.Program)


def native_program(program: Program, generation: int, outlets: Outlets) -> NativeProgram:
    """Make the arrays of a program; `generation` numbers the programs of the process."""
    plans = [plan for several in program.inbound.values() for plan in several]
    made = NativeProgram(generation)
    made.arrays.keep(made.states)
    if outlets.boards is not None:
        made.arrays.include(outlets.boards.arrays)
    targets = TargetWriter(program, outlets, generation, made.arrays, made.states)
    numbers = {plan.route: number for number, plan in enumerate(plans)}
    columns = {name: column for column, name in enumerate(program.table.endpoints)}
    writer = _Writer(program, made, outlets, targets, numbers, columns)
    made.structure = c.Program(
        generation=generation,
        listener_count=len(program.listeners),
        case_count=len(program.envelope.numbers),
        unknown_case=program.counters.index("unhandled", UNKNOWN_CASE),
        schema=ctypes.pointer(wire_schema(program.envelope, program.inbound.keys(), made.arrays)),
        listeners=made.arrays.array(c.Listener, writer.listeners()),
        cases=made.arrays.array(c.PayloadCase, writer.cases()),
        routes=made.arrays.array(c.Route, [writer.route(plan) for plan in plans]),
    )
    return made


def change_to(
    program: NativeProgram, timers: c.TimerChange, deadmen: Sequence[tuple[NativeDeadman, NativeDeadman]] = ()
) -> c.Change:
    """Return the change for the receive thread. `deadmen` are pairs of a deadman and the one that it replaces."""
    addresses = [deadman.address for pair in deadmen for deadman in pair]
    return c.Change(
        program=ctypes.pointer(program.structure),
        replaced=(ctypes.c_void_p * len(addresses))(*addresses),
        timers=timers,
        replaced_count=len(deadmen),
    )


@dataclass(frozen=True, slots=True)
class _Writer:
    program: Program
    made: NativeProgram
    outlets: Outlets
    targets: TargetWriter
    numbers: Mapping[str, int]
    """Numbers of the routes."""
    columns: Mapping[str, int]
    """Columns of the endpoints; unknown senders have the column after the last one."""

    @property
    def counters(self) -> Counters:
        return self.program.counters

    # senders and payload cases

    def cases(self) -> list[c.PayloadCase]:
        members = sorted((number, name) for name, number in self.program.envelope.numbers.items())
        rows = {number: row for row, number in enumerate(self.program.inbound)}
        return [
            c.PayloadCase(
                number=number,
                row=rows.get(number, -1),
                is_ignored=number in self.program.ignored,
                unhandled=self.counters.index("unhandled", name),
            )
            for number, name in members
        ]

    def listeners(self) -> list[c.Listener]:
        return [self._listener(plan.name, plan.framing) for plan in self.program.listeners]

    def _listener(self, name: str, framing: Framing) -> c.Listener:
        opened, counters = self.outlets.listeners[name], self.counters
        peers = list(self._peers(name))
        rejected = [counters.index("datagrams_rejected", name, reason) for reason in REJECTIONS]
        return c.Listener(
            fd=opened.socket.fileno(),
            id=self.outlets.names.number(name),
            repairs=framing is Framing.ZERO_TRIMMED,
            keeps_input=opened.is_inherited,
            peers=self.made.arrays.array(c.Peer, peers),
            choices=self.made.arrays.array(c.Choice, list(self._choices())),
            peer_count=len(peers),
            columns=len(self.columns) + 1,
            received=counters.index("datagrams_received", name),
            received_bytes=counters.index("received_bytes", name),
            padded=counters.index("datagrams_padded", name),
            superseded=counters.index("superseded_members", name),
            rejected=tuple(rejected),
        )

    def _peers(self, listener: str) -> Iterator[c.Peer]:
        """Yield the peers by address; those with a port come first, as they have priority."""
        by_host, by_address = recognisers(self.program.table.endpoints, listener)
        known = [(host, port, name) for (host, port), name in by_address.items()]
        known += [(host, 0, name) for host, name in by_host.items()]
        for address, _, port, name in sorted((_number(host), not port, port, name) for host, port, name in known):
            last_seen, heard_since, silences, last_silence = (
                self.counters.index(metric, name) for metric in ENDPOINT_METRICS
            )
            yield c.Peer(
                address=address,
                port=port,
                column=self.columns[name],
                last_seen=last_seen,
                heard_since=heard_since,
                silences=silences,
                last_silence=last_silence,
                id=self.outlets.names.number(name),
                pause=_pause(self.program.table.endpoints[name]),
            )

    def _choices(self) -> Iterator[c.Choice]:
        """Yield the choices by row, as in `cases`: a column for each endpoint, and a last one for unknown senders."""
        for plans in self.program.inbound.values():
            by_source = {source: plan for plan in plans for source in plan.sources}
            stranger = self._choice(by_source.get(STRANGER), STRANGER)
            for name in self.columns:
                found = by_source.get(name)
                yield self._choice(found, name) if found else stranger
            yield stranger

    def _choice(self, plan: RoutePlan | None, source: str | None) -> c.Choice:
        if plan is None:
            return c.Choice(route=-1)
        received = self.counters.index("messages_received", plan.route, source_label(source))
        return c.Choice(route=self.numbers[plan.route], received=received)

    # routes

    def route(self, plan: RoutePlan) -> c.Route:
        lowered, of_datagrams = self.program.lowered, self.targets.of_datagrams
        topics = [target for target in plan.targets if target.is_topic]
        destinations = [target for target in plan.targets if not target.is_topic]
        made = c.Route(
            sends=of_datagrams(plan, destinations, lowered.to_destinations.get(plan.route)),
            last_message=self.counters.index("route_silence_seconds", plan.route),
            duration=self.counters.index("route_duration_seconds", plan.route),
        )
        if topics:
            made.publishes = of_datagrams(plan, topics, lowered.to_topics[plan.route])
        awaited = [*self._awaited(plan)]
        made.witnesses = self.made.arrays.array(c.Witness, [self._witness(*each) for each in awaited])
        made.witness_count = len(awaited)
        for index, (deadman, _) in enumerate(awaited):
            self.made.states.add_witness(self.outlets, made.witnesses[index], deadman)
        return made

    def _awaited(self, plan: RoutePlan) -> Iterator[tuple[str, str]]:
        """Yield the deadmen, by route, that await messages of this route, each with an endpoint that sends them."""
        for deadman in self.program.deadmen:
            if deadman.obeyed is not None and deadman.obeyed.case == plan.case.name:
                yield from ((deadman.route, name) for name in deadman.obeyed.endpoints if name in plan.sources)

    def _witness(self, deadman: str, endpoint: str) -> c.Witness:
        """Make a witness without its deadman."""
        lowered = self.program.lowered.obeyed[deadman]
        routines = Routines(lowered.layout, self.made.arrays)
        routine = routines.routine(lowered.routine)
        return c.Witness(
            condition=routine,
            layout=routines.layout(),
            sources=self.targets.names_of_senders(),
            column=self.columns[endpoint],
            deadman_id=self.outlets.names.number(deadman),
            endpoint_id=self.outlets.names.number(endpoint),
        )


def _number(host: str) -> int:
    return int.from_bytes(socket.inet_aton(host), "big")
