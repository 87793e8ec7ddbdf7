"""Writes the image of a compiled table.

The compiler has decided everything; here names become indexes, and structures become memory.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from router import declared as c
from router.compiler.compiled_table import STRANGER, CompiledTable, DeadmanPlan, RoutePlan, is_service, source_label
from router.compiler.lowering import LoweredFeed
from router.compiler.lowering.arrays import Arrays
from router.compiler.metrics import ENDPOINT_METRICS, UNKNOWN_CASE, Counters
from router.compiler.network import destination, may_learn, networks_of, recognisers, sent_from
from router.compiler.refusals import REJECTIONS
from router.declared import NONE
from router.hosts import as_ipv6
from router.image.boards import write_boards
from router.image.image import Image
from router.image.memory import Memory, Symbols, address_in
from router.image.names import Names
from router.image.openings import Openings
from router.image.targets import TargetWriter, Timer, write_for_each
from router.image.wire_schema import write_schema
from router.table.model.endpoints import STALE_AFTER, Endpoint, Framing, Listener
from router.types.protobuf import Envelope


def write_image(program: CompiledTable, names: Names | None = None) -> Image:
    """Write the image of a table. It adds to `names`, the names of the process. Equal tables have equal images."""
    names, arrays = names or Names(), Arrays()
    openings = Openings(program, names)
    for listener, endpoint in program.links:
        openings.link(listener, endpoint)
    for deadman in program.deadmen:
        openings.deadman(deadman)
    pacers = [Timer(each) for each in openings.pacers()]
    targets = TargetWriter(program, openings, arrays, write_boards(program.boards, arrays))
    plans = [plan for several in program.inbound.values() for plan in several]
    numbers = {plan.route: number for number, plan in enumerate(plans)}
    columns = {name: column for column, name in enumerate(program.table.endpoints)}
    structure = arrays.add(_Writer(program, targets, numbers, columns).program_of(plans))
    ros = {topic: _ros_routes(targets, topic, feeds) for topic, feeds in program.lowered.from_ros.items()}
    for client_deadman in program.client_deadmen:
        openings.client_deadman(client_deadman)
    memory = Memory(arrays)
    relocatable = memory.relocatable()
    return Image(
        **relocatable._asdict(),
        symbols=openings.symbols.all,
        program=memory.offset(ctypes.addressof(structure)),
        listener_array=memory.offset(address_in(structure, "listeners")) if program.listeners else 0,
        ros_topics=[
            (topic, memory.offset(ctypes.addressof(routes)), len(routes), any(feed.is_urgent for feed in feeds))
            for (topic, feeds), routes in zip(program.lowered.from_ros.items(), ros.values(), strict=True)
            if not is_service(topic)
        ],
        requests=[(label, memory.offset(ctypes.addressof(ros[label]))) for label in program.request_labels],
        listeners=[
            (each.name, tuple(each.address.value), each.interface, each.receive_buffer, each.group_hosts)
            for each in program.table.sockets
        ],
        senders=[
            (each.name, *destination(program.table, each), sent_from(program.table, each))
            for each in program.udp_senders
        ],
        link_ends=[(each.name, str(each.address.value)) for _, each in program.links],
        servers=[each.name for each in program.table.links if each.accepts],
        topics=[(each.label, each.qos.serves_late_joiners) for each in program.publishers],
        hosts=sorted(openings.hosts),
        openings=[*openings.listed.values()],
        timers=[_timer(each, memory) for each in (*pacers, *targets.timers)],
        deadmen=[_deadman(plan) for plan in program.deadmen],
        client_deadmen=[_deadman(plan) for plan in program.client_deadmen],
        names=names.all(),
        series=program.counters.indexes(),
        counters=program.counters.size,
        mirror_lost=program.counters.index("mirror_dropped") if program.table.record is not None else None,
    )


def _timer(timer: Timer, memory: Memory) -> tuple[int, bool, int | None, int | None]:
    targets, target = (None if each is None else memory.offset(each) for each in (timer.targets, timer.target))
    return Symbols.number(timer.symbol), timer.is_topic, targets, target


def _deadman(plan: DeadmanPlan) -> tuple[str, list[str], list[tuple[str, str]]]:
    return plan.route, [name for name, _ in plan.datagrams], sorted(plan.watched)


def _pause(endpoint: Endpoint) -> int:
    """Return the longest pause (ns) between two datagrams that is no silence.

    `stale_after` is the time after which silence is a problem. By default it is 5 s, and a board that is reset takes
    about 2 s: so 2/5 of it. An endpoint that is never stale has no silences.
    """
    return c.NEVER if endpoint.stale_after is None else endpoint.stale_after * 2 // 5


@dataclass(frozen=True, slots=True)
class _Writer:
    """Writes what the receive thread executes: listeners, payload cases, and routes from UDP."""

    program: CompiledTable
    targets: TargetWriter
    numbers: Mapping[str, int]
    """Numbers of the routes."""
    columns: Mapping[str, int]
    """Columns of the endpoints; unknown senders have the column after the last one."""

    @property
    def counters(self) -> Counters:
        return self.program.counters

    @property
    def arrays(self) -> Arrays:
        return self.targets.arrays

    def program_of(self, plans: list[RoutePlan]) -> c.Program:
        protocols = {
            name: ctypes.pointer(self._protocol(each)) for name, each in self.program.envelopes.by_name.items()
        }
        listeners = [self._listener(each, None, protocols) for each in self.program.table.sockets]
        listeners += [self._listener(each, end, protocols) for each, end in self.program.links]
        return c.Program(
            listener_count=len(listeners),
            state_count=len(self.program.states),
            states=self.targets.states,
            listeners=self.arrays.array(c.Listener, listeners),
            routes=self.arrays.array(c.Route, [self._route(plan) for plan in plans]),
        )

    def _protocol(self, envelope: Envelope) -> c.Protocol:
        return self.arrays.add(
            c.Protocol(
                schema=write_schema(envelope, self.program.inbound, self.arrays),
                cases=self.arrays.array(c.PayloadCase, self._cases(envelope)),
                case_count=len(envelope.numbers),
                unknown_case=self.counters.index("unhandled", UNKNOWN_CASE),
            )
        )

    # senders and payload cases

    def _cases(self, envelope: Envelope) -> list[c.PayloadCase]:
        members = sorted((number, name) for name, number in envelope.numbers.items())
        rows = {name: row for row, name in enumerate(self.program.inbound)}
        return [
            c.PayloadCase(
                number=number,
                row=rows.get(name, -1),
                is_ignored=name in self.program.ignored,
                unhandled=self.counters.index("unhandled", name),
            )
            for number, name in members
        ]

    def _listener(
        self, plan: Listener, end: Endpoint | None, protocols: Mapping[str, ctypes._Pointer[c.Protocol]]
    ) -> c.Listener:
        """Write a socket, which is opened later, or the link to the endpoint `end`.

        `protocols` are by the name of the envelope.
        """
        counters, name = self.counters, plan.name
        peers, learned = list(self._peers(name)), list(self._learned(name))
        return c.Listener(
            fd=-1,
            id=self.targets.openings.names.number(name),
            repairs=plan.framing is Framing.ZERO_TRIMMED,
            link=self.targets.openings.link(plan, end) if end is not None else None,
            protocol=protocols[self.program.envelopes.listeners[name]],
            peers=self.arrays.array(c.Peer, peers),
            learned=self.arrays.array(c.LearnedPeer, learned),
            choices=self.arrays.array(c.Choice, list(self._choices())),
            peer_count=len(peers),
            learned_count=len(learned),
            columns=len(self.columns) + 1,
            received=counters.index("datagrams_received", name),
            received_bytes=counters.index("received_bytes", name),
            padded=counters.index("datagrams_padded", name),
            superseded=counters.index("superseded_members", name),
            rejected=tuple(counters.index("datagrams_rejected", name, reason) for reason in REJECTIONS),
        )

    def _peers(self, listener: str) -> Iterator[c.Peer]:
        """Yield the peers by address; those with a port come first, as they have priority."""
        by_host, by_address = recognisers(self.program.table, listener)
        known = [(host, port, name) for (host, port), name in by_address.items()]
        known += [(host, 0, name) for host, name in by_host.items()]
        number = self.targets.openings.host
        for address, _, port, name in sorted((number(host), not port, port, name) for host, port, name in known):
            peer = self._peer(name)
            peer.address, peer.port = address, port
            yield peer

    def _peer(self, name: str) -> c.Peer:
        """Write an endpoint as a sender, without its address."""
        last_seen, heard_since, silences, last_silence = (
            self.counters.index(metric, name) for metric in ENDPOINT_METRICS
        )
        return c.Peer(
            column=self.columns[name],
            last_seen=last_seen,
            heard_since=heard_since,
            silences=silences,
            last_silence=last_silence,
            id=self.targets.openings.names.number(name),
            pause=_pause(self.program.table.endpoints[name]),
        )

    def _learned(self, listener: str) -> Iterator[c.LearnedPeer]:
        """Yield the endpoints whose address this listener learns."""
        table = self.program.table
        place = table.listeners[listener]
        sent_to = {each.name for each in self.program.senders}
        for endpoint in table.endpoints.values():
            if not endpoint.address.value.is_learned or not may_learn(table, endpoint, place):
                continue
            networks = [
                c.Network(
                    address=tuple(as_ipv6(str(each.network_address))), prefix=each.prefixlen + 128 - each.max_prefixlen
                )
                for each in networks_of(table, endpoint, place)
            ]
            yield c.LearnedPeer(
                peer=self._peer(endpoint.name),
                sender=self.targets.openings.sender(endpoint.name) if endpoint.name in sent_to else None,
                networks=self.arrays.array(c.Network, networks),
                network_count=len(networks),
                port=endpoint.source_port.value if endpoint.source_port else 0,
                origin=self.counters.index("endpoint_learned", endpoint.name),
                stale_after=c.NEVER if endpoint.stale_after is None else endpoint.stale_after,
            )

    def _choices(self) -> Iterator[c.Choice]:
        """Yield the choices by row, as in `_cases`: a column for each endpoint, and a last one for unknown senders."""
        for plans in self.program.inbound.values():
            by_source = {source: plan for plan in plans for source in plan.sources}
            stranger = self._choice(by_source.get(STRANGER), STRANGER)
            for name in self.columns:
                plan = by_source.get(name)
                yield self._choice(plan, name) if plan else stranger
            yield stranger

    def _choice(self, plan: RoutePlan | None, source: str | None) -> c.Choice:
        if plan is None:
            return c.Choice(route=c.NO_ROUTE)
        received = self.counters.index("messages_received", plan.route, source_label(source))
        number = self.numbers[plan.route]
        return c.Choice(
            route=c.ORDERED - number if plan.route in self.program.lowered.order else number, received=received
        )

    # routes

    def _route(self, plan: RoutePlan) -> c.Route:
        lowered, of_datagrams = self.program.lowered, self.targets.of_datagrams
        topics = [target for target in plan.targets if target.is_topic]
        destinations = [target for target in plan.targets if not target.is_topic and not target.reply]
        route = c.Route(
            sends=of_datagrams(plan, destinations, lowered.to_destinations.get(plan.route)),
            last_message=self.counters.index("route_silence_seconds", plan.route),
            duration=self.counters.index("route_duration_seconds", plan.route),
        )
        if topics:
            route.publishes = of_datagrams(plan, topics, lowered.to_topics[plan.route])
        if plan.route in lowered.order:
            route.order = ctypes.pointer(self.arrays.add(self._ordering(plan.route)))
        route.effects = self._effects(plan)
        return route

    def _effects(self, plan: RoutePlan) -> Any:
        """Write what else is done with each message of a route; None without any."""
        setters, witnesses = [*self.targets.setters(plan)], [*self._witnesses(plan)]
        replies = self.targets.replies(plan)
        if not setters and not witnesses and replies is None:
            return None
        effects = c.Effects(
            setters=self.arrays.array(c.Setter, setters),
            witnesses=self.arrays.array(c.Witness, witnesses),
            replies=replies,
            setter_count=len(setters),
            witness_count=len(witnesses),
        )
        return ctypes.pointer(self.arrays.add(effects))

    def _ordering(self, route: str) -> c.Ordering:
        lowered, endpoints = self.program.lowered.order[route], self.program.table.endpoints.values()
        routines = self.targets.routines(lowered.layout)
        patience = [*(each.stale_after or STALE_AFTER for each in endpoints), STALE_AFTER]
        return c.Ordering(
            state=self.targets.openings.order(route),
            number=routines.routine(lowered.routine),
            layout=routines.layout(),
            sources=self.targets.names_of_senders(),
            patience=self.arrays.array(ctypes.c_int64, patience),
            bits=lowered.bits,
            is_unsigned=lowered.is_unsigned,
        )

    def _witnesses(self, plan: RoutePlan) -> Iterator[c.Witness]:
        """Yield a witness for each deadman that awaits messages of this route, and each endpoint that sends them."""
        for deadman in self.program.deadmen:
            if plan.case is not None and deadman.obeyed is not None and deadman.obeyed.case.name == plan.case.name:
                yield from (self._witness(deadman, name) for name in deadman.obeyed.endpoints if name in plan.sources)

    def _witness(self, deadman: DeadmanPlan, endpoint: str) -> c.Witness:
        lowered, openings = self.program.lowered.obeyed[deadman.route], self.targets.openings
        routines = self.targets.routines(lowered.layout)
        return c.Witness(
            deadman=openings.deadman(deadman),
            condition=routines.routine(lowered.routine),
            layout=routines.layout(),
            sources=self.targets.names_of_senders(),
            column=self.columns[endpoint],
            deadman_id=openings.names.number(deadman.route),
            endpoint_id=openings.names.number(endpoint),
        )


def _ros_routes(writer: TargetWriter, topic: str, feeds: tuple[LoweredFeed, ...]) -> ctypes.Array[c.RosRoute]:
    """Write the routes of a topic from ROS: an array of `struct ros_route` of `native/route_ros.h`."""
    plans = {plan.route: plan for plan in writer.program.outbound[topic]}
    array: ctypes.Array[c.RosRoute] = writer.arrays.array(
        c.RosRoute, [_ros_route(writer, plans[feed.route], feed) for feed in feeds]
    )
    return array


def _ros_route(writer: TargetWriter, plan: RoutePlan, feed: LoweredFeed) -> c.RosRoute:
    assert plan.topic is not None  # noqa: S101 - a route from ROS has a topic
    counters, routines = writer.program.counters, writer.routines(feed.layout)
    targets = writer.targets(plan, plan.targets, routines)
    for_each = write_for_each(feed.for_each, routines)
    targets.layout = routines.layout()
    seconds, nanoseconds = feed.stamp or (NONE, NONE)
    return c.RosRoute(
        targets=targets,
        for_each=for_each,
        setter=writer.setter_of_topic(plan),
        seconds=seconds,
        nanoseconds=nanoseconds,
        received=counters.index("messages_received", plan.route, plan.topic),
        last_message=counters.index("route_silence_seconds", plan.route),
        duration=counters.index("route_duration_seconds", plan.route),
    )
