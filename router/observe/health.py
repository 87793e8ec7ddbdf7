"""Decides what is wrong with a running router.

The status page, `/diagnostics`, `router status`, `router top` and doctor all show `HealthSnapshot.problems`. The
Prometheus alerts are named after the kinds; tests compare words, levels and thresholds.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain, pairwise
from math import inf
from typing import TYPE_CHECKING

from router.compiler.metrics import (
    COMMAND,
    INTENDED_REASONS,
    PUBLISHER,
    SERVED_STATES,
    SHARES_NODE,
    SHARES_TOPIC,
    SUBSCRIBER,
    UNKNOWN_CASE,
    UNSENT_REASONS,
    Mismatch,
    only,
)
from router.errors import listed
from router.observe.bursts import Burst
from router.observe.obedience import Replies, why_disobeyed
from router.observe.problems import DROPS, Kind, Problem
from router.observe.senders import MOST_NAMED, Senders, few
from router.observe.snapshot import SERIES, Labels, Snapshot
from router.observe.states import StateReading, state_readings
from router.table.addresses import SerialPlace
from router.table.model.endpoints import Endpoint, EndpointKind
from router.table.model.routes import ANY
from router.values.printing import age_text

if TYPE_CHECKING:
    from router.compiler.compiled_table import CompiledTable

PERIOD = 1.0
"""Seconds between two snapshots."""

WINDOW = 10
"""Seconds for which a loss remains a problem, so that a short one is not overlooked."""

RETURNED = 300
"""Seconds for which a silence that has ended is shown."""

REMEDIES: Mapping[str, str] = {
    "send_error": (
        "{target} does not answer or listen, or the network rejects them: check that it runs, cable and address; the "
        "log has the error."
    ),
    "send_buffer_full": (
        "{target} does not answer: check power, cable and address. If it answers, the network is too slow: route less."
    ),
    "queue_full": "They exceed `bandwidth`, or a thread is behind: route less to this target, or raise the bandwidth.",
    "stale": (
        "They waited in this computer for longer than `ttl`: the router was stopped, or is behind (`router top`); or "
        "`bandwidth` is too small."
    ),
    "premature": "Set the clocks of the clients and of this computer by NTP: the log says how far they differ.",
    "publish_error": "The ROS middleware rejects them: see the log for the reason.",
    "mapping_error": "The mapping fails on these values, for example dividing by zero: see `router explain`.",
    "non_finite": "A value is NaN or infinite: check what the sender measures.",
    "too_large": "They are larger than the receiver accepts: see the log for the field and its limit.",
    "superseded": (
        "A newer command of another route disarmed their deadman. If it goes on, two senders command {target}: stop "
        "one of them."
    ),
    "overloaded": "The gateway converts them more slowly than they arrive: exclude them, or lower their `rates`.",
    "missing_field": "A `required` field is missing: the sender must set it; the log names it.",
    "out_of_order": (
        "They arrive twice, or after newer ones: check the network for two paths. If it goes on, the sender does not "
        "count up: see `order` of the route."
    ),
    "incomplete": "Datagrams of their frames are lost or late: check the link, or raise `timeout` of `collect`.",
    "source_mismatch": "No route accepts them from that address: run `router tap --only rejected` to see the senders.",
    "unknown_case": "The sender's protos are newer than the router's: update them.",
    "malformed": "They cannot be parsed: check that sender and router have the same protos, and the `framing`.",
    "truncated": "They are longer than the router accepts (16 KiB): send smaller ones.",
    "no_payload": "They are envelopes without a payload: run `router tap --only rejected` to see who sends them.",
    "disk_full": "Free space on the disk of `record.directory` before you stop the router, which retries every 10 s.",
    "read_only": "Remount the disk of `record.directory` writable (`dmesg` says why it is not); the router retries.",
    "no_permission": "Make `record.directory` writable for the user of the router, which retries every 10 s.",
    "disk_error": "The disk of `record.directory` fails: `dmesg` and the log say why; the router retries every 10 s.",
    "bad_frame": "Check `baud`, `framing` and the wires: what arrives are no frames.",
    "bad_checksum": "Check `checksum`, and the wires and ground of the line: bytes are changed on the way.",
    "empty": "They are empty: run `router tap --only rejected` to see who sends them.",
    "not_installed": "`router explain {route} --live` shows their types: source their packages, or exclude the topics.",
    "over_limit": "The log names some. Name those that you need in `include`, exclude others, or raise `max_topics`.",
    "refused": "The log names them, with the reason. If the table has them with another type, exclude them.",
}
"""Remedies by the reason of a loss, or the state of a gateway's topic."""

_STALE_FROM_ROS = (
    "They are older than `ttl`: their node sends them late, the router is behind, or the clock of the node's computer "
    "is slow."
)
"""ROS messages have the time when they were sent; the age of a datagram counts from its arrival."""

_MORE: Mapping[Kind, str] = {
    Kind.GROUP_NOT_JOINED: ", {:.0f} of them missing",
    Kind.QOS_INCOMPATIBLE: ", {:.0f} of them",
    Kind.GATEWAY_CLIENT_SLOW: " by {:.0f} s",
    Kind.GATEWAY_TOPIC_NOT_SERVED: ", {:.0f} of them",
    Kind.RECORDING_UNSAVED: ", {:.0f} of them",
}
"""The text that gives the value, for kinds where it matters."""

_GAUGES = (Kind.LISTENER_WAITING, Kind.ENDPOINT_UNRESOLVED, Kind.NODE_NAME_TAKEN, *_MORE)
_LOSSES = (
    Kind.DEADMAN_CANNOT_SEND,
    *DROPS,
    Kind.KERNEL_DROPS,
    Kind.DATAGRAMS_REJECTED,
    Kind.MEMBERS_SUPERSEDED,
    Kind.UNHANDLED_CASE,
    Kind.RECORDING_INCOMPLETE,
)
_NO_LOSS = {*INTENDED_REASONS, "unhandled"}
"""Reasons of intended losses, and the one that UNHANDLED_CASE reports."""

_ALSO_LOST = "mirror_dropped", "recordings_lost"
"""Further metrics of RECORDING_INCOMPLETE."""

_OTHER_ADDRESS = (
    "If {sender} is {endpoint}, give it the address {address}, or correct `endpoints` and run `router reload`; "
    "`router tap --only rejected` shows what it sends."
)
_NOT_LEARNED = (
    "It gets nothing before it sends: check that it runs, and sends to a listener of this computer that accepts it."
)
_NOT_LEARNED_FROM = (
    "If {sender} is {endpoint}, its port, network or listener is another one than `endpoints` says, or it has to wait "
    "until the earlier sender is silent for `stale_after`."
)
_FROM_TOPIC = "Have it send what a route accepts, or write a route for {payload_case} with this `source`."
_WITHHELD = "They do not meet a condition (`when`) of the table: `router explain {route}` shows it."
_SILENT_LINE = (
    "Check its power, and the wires of {address}; compare `baud`, `framing` and `checksum` with its firmware's."
)
_NO_BRAKE_ON_LINE = (
    "Stop the rover by other means. Check plug and power of {destination}, and that no other program has its serial "
    "line: `fuser -v {address}`."
)
_ON_LINE: Mapping[str, str] = {
    "send_error": "Its serial line is closed: check plug and power, and `fuser -v {address}`; the log says why.",
    "send_buffer_full": (
        "Its serial line is full. Does its firmware read? Else raise `baud` on both sides, give {target} a `bandwidth` "
        "below it, or route less."
    ),
}
"""Remedies for messages to the other end of a serial line that are dropped, by reason."""
_CLOSED_CONNECTION = "Check power and network of {endpoint}, and whether its program runs; the log says why."
_ALL_SILENT = "All endpoints are silent: check this computer's network: cable, switch, radio."


@dataclass(frozen=True)
class HealthSnapshot:
    """The state of a router. `snapshots` are those of the last WINDOW seconds, oldest first.

    Times in seconds. `stalled_for`: how long the receive thread has made no progress. `tripped`: how long each active
    deadman has been sending, by route. `mismatches`: recent senders of messages that no route accepts from them, judged
    by this program. `replies`: what boards have shown about the brakes of active deadmen. `bursts`: recent bursts of
    commands, by route. `returned`: how long ago each endpoint was heard again after its last silence.
    """

    program: CompiledTable
    snapshots: Sequence[Snapshot]
    stalled_for: float
    tripped: Mapping[str, float]
    mismatches: frozenset[Mismatch] = frozenset()
    replies: Replies = field(default_factory=dict)
    bursts: Mapping[str, Burst] = field(default_factory=dict)
    returned: Mapping[str, float] = field(default_factory=dict)
    _grown: dict[str, Collection[tuple[Labels, int]]] = field(default_factory=dict, init=False, repr=False)

    @property
    def now(self) -> Snapshot:
        return self.snapshots[-1]

    @property
    def seconds(self) -> float:
        """The time from the first to the last snapshot."""
        return max(self.now.at - self.snapshots[0].at, 1e-9)

    def grown(self, metric: str) -> Collection[tuple[Labels, int]]:
        """Return the series that have grown since the first snapshot, and by how much."""
        if metric not in self._grown:
            earlier, now = self.snapshots[0].counts(metric), self.now.counts(metric)
            grown = ((labels, int(value - earlier.get(labels, 0))) for labels, value in now.items() if value)
            self._grown[metric] = [(labels, more) for labels, more in grown if more > 0]
        return self._grown[metric]

    @cached_property
    def silence(self) -> Mapping[str, float]:
        """How long each endpoint has been silent, or has not been heard yet."""
        metrics = (Kind.ENDPOINT_NEVER_HEARD.metric, Kind.ENDPOINT_SILENT.metric)
        return {name: seconds for metric in metrics for (name,), seconds in self.now.counts(metric).items()}

    def address_of(self, endpoint: Endpoint) -> str:
        """Return the address of an endpoint as text; if it is learned, that one, or "not learned yet"."""
        address = endpoint.address.value
        return self.learned.get(endpoint.name, "not learned yet") if address.is_learned else str(address)

    def was_heard(self, endpoint: str) -> bool:
        return (endpoint,) in self.now.counts(Kind.ENDPOINT_SILENT.metric)

    @cached_property
    def learned(self) -> Mapping[str, str]:
        """The learned addresses, by endpoint."""
        return {labels[0]: labels[1] for labels in self.now.counts("endpoint_learned")}

    @cached_property
    def states(self) -> tuple[StateReading, ...]:
        return tuple(state_readings(self.program, self.now))

    @cached_property
    def problems(self) -> tuple[Problem, ...]:
        """All problems, in the order of kinds."""
        found = chain(
            self._states(),
            self._silent(),
            self._returned(),
            self._tripped(),
            self._disobeyed(),
            self._waiting(),
            self._mistyped(),
            self._other_routers(),
            self._closed(),
            self._burst(),
            *map(self._above, _GAUGES),
            *map(self._lost, _LOSSES),
        )
        rank = {kind: place for place, kind in enumerate(Kind)}
        return tuple(sorted(found, key=lambda problem: rank[problem.kind]))

    @cached_property
    def halted(self) -> frozenset[str]:
        """The routes that nobody drives.

        Their deadman has been sending for a long time, reaches its endpoints, no command is dropped or rejected, and
        no sender of commands is out of reach.
        """
        rejected = {each.payload_case for each in self.mismatches if self._senders.expected(each)}
        lost = self._stale & self._unsent.keys()
        failing = {route.name for route in self.program.table.routes if route.case.value in rejected}
        failing |= {route for route, names in self._sources.items() if names & lost}
        failing |= {labels[0] for labels, _ in self.grown(Kind.DEADMAN_CANNOT_SEND.metric)}
        for labels, _ in self.grown(Kind.MESSAGES_DROPPED.metric):
            named = dict(zip(SERIES[Kind.MESSAGES_DROPPED.metric], labels, strict=True))
            if named["reason"] not in _NO_LOSS:
                failing.add(named["route"])
        return frozenset(route for route, s in self.tripped.items() if s > Kind.HALTED.threshold) - failing

    @cached_property
    def away(self) -> Mapping[str, Sequence[str]]:
        """By halted route, the senders of its commands that are silent because nobody drives.

        Boards do not count, nor does a sender that is out of reach or has another address.
        """
        endpoints = self.program.table.endpoints
        away = {
            name
            for name in self._stale - self._unsent.keys()
            if endpoints[name].kind is not EndpointKind.BOARD
            and self.was_heard(name)
            and not self._senders.in_place_of(name)
        }
        return {route: sorted(away & self._sources.get(route, set())) for route in sorted(self.halted)}

    @cached_property
    def _senders(self) -> Senders:
        return Senders(self.program, self.mismatches, self.learned)

    @property
    def _sources(self) -> Mapping[str, set[str]]:
        return self._senders.sources

    @cached_property
    def _limits(self) -> Mapping[str, float]:
        """The `stale_after` (s) of each endpoint that a route accepts messages from."""
        senders = {name for names in self._sources.values() for name in names}
        return {
            endpoint.name: endpoint.stale_after / 1e9
            for endpoint in self.program.table.endpoints.values()
            if endpoint.stale_after is not None and endpoint.name in senders
        }

    @cached_property
    def _stale(self) -> set[str]:
        return {name for name, limit in self._limits.items() if self.silence.get(name, 0.0) > limit}

    @cached_property
    def _unsent(self) -> Mapping[str, Counter[str]]:
        """By endpoint that messages could not be sent to, how many of which route."""
        unsent: dict[str, Counter[str]] = defaultdict(Counter)
        for (route, target, reason), count in self.grown(Kind.MESSAGES_DROPPED.metric):
            if target in self.program.table.endpoints and reason in UNSENT_REASONS:
                unsent[target][route] += count
        return unsent

    def _states(self) -> Iterator[Problem]:
        if self.stalled_for > Kind.RECEIVE_STUCK.threshold:
            yield self._problem(Kind.RECEIVE_STUCK, {}, f": no progress for {age_text(self.stalled_for)}")
        if not self.now.total(Kind.RELOAD_FAILED.metric):
            yield self._problem(Kind.RELOAD_FAILED, {})
        for (name, mode), connections in self.now.counts(Kind.GATEWAY_DISCONNECTED.metric).items():
            if mode == "client" and not connections:
                yield self._problem(Kind.GATEWAY_DISCONNECTED, {"route": name})

    def _silent(self) -> Iterator[Problem]:
        """Yield silent endpoints, first those whose commands a deadman replaces."""
        silent, away = self._stale, set(chain.from_iterable(self.away.values()))
        held = set(chain.from_iterable(self._sources.get(route, ()) for route in self.tripped))
        for name in sorted(silent - away, key=lambda name: (name not in held, name)):
            kind, more = Kind.ENDPOINT_NEVER_HEARD, ""
            if self.was_heard(name):
                kind, more = Kind.ENDPOINT_SILENT, f": last heard {age_text(self.silence[name])} ago"
                if lost := self._unsent.get(name):
                    more += f", and does not answer: {self._amount(lost)} for it lost in {self._span}"
            routes = tuple(route for route, names in self._sources.items() if name in names and names <= silent)
            problem = Problem(kind, {"endpoint": name}, more, self._remedy_for_silence(name), routes)
            if (sender := self._senders.in_place_of(name)) is not None:
                labels = {"endpoint": name, "sender": sender}
                problem = problem._replace(labels=labels, more=f"{more}, while {sender} sends its messages")
            yield problem

    def _remedy_for_silence(self, endpoint: str) -> str:
        address = self._senders.host(endpoint)
        if (sender := self._senders.in_place_of(endpoint)) is not None:
            if self._senders.is_learned(endpoint):
                return _NOT_LEARNED_FROM.format(endpoint=endpoint, sender=sender)
            return _OTHER_ADDRESS.format(endpoint=endpoint, address=address, sender=sender)
        if len(self._stale) == len(self._limits) > 1:
            return _ALL_SILENT
        if self._is_on_line(endpoint):
            return _SILENT_LINE.format(address=address)
        if not address:
            return _NOT_LEARNED.format(endpoint=endpoint)
        return Kind.ENDPOINT_SILENT.remedy_at(address)

    @property
    def _span(self) -> str:
        return f"{max(self.seconds, 1):.0f} s"

    def _amount(self, counts: Counter[str]) -> str:
        """Return a number of losses with the routes that have most of them."""
        routes = [route for route, _ in counts.most_common() if route]
        of = f" of {', '.join(routes[:MOST_NAMED])}" if routes else ""
        more = len(routes) - MOST_NAMED
        return f"{counts.total()}{of}" + (f" and {more} more routes" if more > 0 else "")

    def _returned(self) -> Iterator[Problem]:
        """Yield endpoints that were silent a while ago."""
        for name, ago in self.returned.items():
            if ago < RETURNED and name not in self._stale:
                silence = self.now.of("endpoint_last_silence_seconds", name).get((), 0.0)
                more = f": for {silence:.1f} s, until {age_text(ago)} ago"
                yield self._problem(Kind.ENDPOINT_RETURNED, {"endpoint": name}, more)

    def _tripped(self) -> Iterator[Problem]:
        """Yield the deadmen that send in place of commands, with the cause."""
        for route, seconds in self.tripped.items():
            kind, more, remedy = Kind.DEADMAN_ACTIVE, *self._cause(route)
            if route in self.halted:
                kind, more, remedy = Kind.HALTED, f" for {age_text(seconds)}", ""
                if silent := self.away[route]:
                    more += f", and {listed(silent)} {'is' if len(silent) == 1 else 'are'} silent"
            more += "".join(f"; {board} stopped after {time:.2f} s" for board, time in self._stopped(route))
            problem = self._problem(kind, {"route": route}, more, (self._owner(route),))
            yield problem._replace(remedy=remedy or problem.remedy)

    def _cause(self, route: str) -> tuple[str, str]:
        """Return why commands of a route do not get through, and the remedy, as far as they are known."""
        sources = self._sources.get(route, set()) - {ANY}
        for name in sorted(sources):
            if (sender := self._senders.in_place_of(name)) is not None:
                return f", while {sender} sends those of {name}", self._remedy_for_silence(name)
        if sources and sources <= self._stale:
            names = sorted(sources)
            verb = "is" if len(names) == 1 else "are"
            return f", and {listed(names)} {verb} silent", self._remedy_for_silence(names[0])
        dropped = sorted(self.grown(Kind.MESSAGES_DROPPED.metric), key=lambda found: -found[1])
        for (of, target, reason), count in dropped:
            if of == self._owner(route) and reason not in _NO_LOSS and self._are_commands(of, target):
                if target in self._stale and reason in UNSENT_REASONS:
                    return f", and {target} does not answer", self._remedy_for_silence(target)
                return f", and {count} for {target} were dropped: {reason}", self._remedy_for_loss(reason, of, target)
        withheld = sorted(self.grown("messages_filtered"), key=lambda found: -found[1])
        for (of, target), count in withheld:
            if of == self._owner(route) and self._are_commands(of, target):
                return f", and {count} for {target} were withheld{self._read_by(of)}", _WITHHELD.format(route=of)
        return "", ""

    def _read_by(self, route: str) -> str:
        """Return the present values of the states that conditions of a route read, in words."""
        read = {state.name for state in self.program.states if route in state.readers}
        return "".join(f", {state.name} is {state.value}" for state in self.states if state.name in read)

    def _stopped(self, route: str) -> Iterator[tuple[str, float]]:
        """Yield the boards that have obeyed the deadman of a route, with their stopping times in seconds."""
        for (of, board), reply in self.replies.items():
            if of == route and reply.stopped is not None:
                yield board, reply.stopped

    def _disobeyed(self) -> Iterator[Problem]:
        """Yield the boards that do not obey the brake of a deadman, with what was sent and what they report."""
        for (route, endpoint), value in self.now.counts(Kind.DEADMAN_DISOBEYED.metric).items():
            if value > Kind.DEADMAN_DISOBEYED.threshold:
                labels = {"route": route, "endpoint": endpoint}
                why = why_disobeyed(self.program, route, endpoint, self.replies)
                yield self._problem(Kind.DEADMAN_DISOBEYED, labels, f": {why}", (route,))

    def _waiting(self) -> Iterator[Problem]:
        """Yield topics whose publish calls are stuck, and messages that wait for a thread."""
        stalls = [(each.at, each.counts(Kind.PUBLISH_STALLED.metric)) for each in self.snapshots]
        for topic, seconds in stalls[-1][1].items():
            between = (min(counts.get(topic, 0.0), at - before) for (before, _), (at, counts) in pairwise(stalls))
            stalled = max(seconds, sum(between))
            if stalled > Kind.PUBLISH_STALLED.threshold:
                yield self._problem(Kind.PUBLISH_STALLED, {"topic": topic[0]}, f" for {age_text(stalled)}")
        counts = [snapshot.counts(Kind.MESSAGES_WAITING.metric) for snapshot in self.snapshots]
        now = [labels for labels, number in counts[-1].items() if number]
        waiting = sum(min(each.get(labels, 0.0) for each in counts) for labels in now)
        if waiting > Kind.MESSAGES_WAITING.threshold:
            yield self._problem(Kind.MESSAGES_WAITING, {}, f", at least {waiting:.0f}")

    def _mistyped(self) -> Iterator[Problem]:
        """Yield the types of peers with which nothing is exchanged."""
        plans = {PUBLISHER: self.program.subscriptions, SUBSCRIBER: self.program.publishers}
        for values, number in self.now.counts(Kind.TYPE_INCOMPATIBLE.metric).items():
            if not number:
                continue
            labels = dict(zip(SERIES[Kind.TYPE_INCOMPATIBLE.metric], values, strict=True))
            kind = Kind.COMMANDS_MISTYPED if labels[COMMAND] == "true" else Kind.TYPE_INCOMPATIBLE
            ours = (plan.type_name for plan in plans[labels["peer"]] if plan.label == labels["topic"])
            more = "".join(f"; {only(labels['peer'], each)}" for each in ours)  # not if a reload has removed the topic
            yield self._problem(kind, labels, more, (labels["route"],))

    def _other_routers(self) -> Iterator[Problem]:
        """Yield the other routers, with what they share with this one."""
        found: dict[tuple[str, str], dict[str, list[str]]] = defaultdict(lambda: defaultdict(list))
        for (host, process, shares, name), value in sorted(self.now.counts(Kind.OTHER_ROUTER.metric).items()):
            if value:
                found[host, process][shares].append(name)
        for (host, process), shared in found.items():
            topics, nodes = shared[SHARES_TOPIC], shared[SHARES_NODE]
            more = f"; boards of both get messages on {listed(topics)} twice" if topics else ""
            more += "".join(f"; both are called {name}" for name in nodes)
            routes = tuple(plan.route for topic in topics for plan in self.program.outbound.get(topic, ()))
            yield self._problem(Kind.OTHER_ROUTER, {"host": host, "process": process}, more, routes)

    def _closed(self) -> Iterator[Problem]:
        for (name,), is_up in self.now.counts(Kind.LINK_CLOSED.metric).items():
            if not is_up:
                closed = self._problem(Kind.LINK_CLOSED, {"endpoint": name})
                remedy = closed.remedy if self._is_on_line(name) else _CLOSED_CONNECTION.format(endpoint=name)
                yield closed._replace(remedy=remedy)

    def _burst(self) -> Iterator[Problem]:
        """Yield routes whose commands may have been stored on their way."""
        for route, burst in self.bursts.items():
            more = f", {burst.messages} in {burst.seconds:.1f} s after {age_text(burst.silence)}"
            yield self._problem(Kind.COMMAND_BURST, {"route": route}, more, (route,))

    def _above(self, kind: Kind) -> Iterator[Problem]:
        for values, value in self.now.counts(kind.metric).items():
            labels = dict(zip(SERIES[kind.metric], values, strict=True))
            if value > kind.threshold and labels.get("state") not in SERVED_STATES:
                routes = (self._owner(labels["route"]),) if "route" in labels else ()
                yield self._problem(kind, labels, _MORE.get(kind, "").format(value), routes)

    def _lost(self, kind: Kind) -> Iterator[Problem]:
        """Yield unintended losses of the last seconds, summed over the labels that the words do not contain.

        Losses towards an endpoint that is silent, or was, are left out where its silence is a problem.
        """
        sums: dict[Labels, Counter[str]] = defaultdict(Counter)
        for metric in (kind.metric, *(_ALSO_LOST if kind is Kind.RECORDING_INCOMPLETE else ())):
            for values, count in self.grown(metric):
                labels = dict(zip(SERIES[metric], values, strict=True))
                is_of_kind = kind not in DROPS or kind is self._drop(labels)
                if is_of_kind and labels.get("reason") not in _NO_LOSS and not self._is_told(kind, labels):
                    route = self._owner(labels.get("route", ""))
                    sums[tuple(labels[label] for label in kind.labels)][route] += count
        for values, counts in sums.items():
            if counts.total() / self.seconds > kind.threshold:
                yield self._loss(kind, dict(zip(kind.labels, values, strict=True)), counts)

    def _is_told(self, kind: Kind, labels: Mapping[str, str]) -> bool:
        """Return whether another problem names this loss."""
        if kind is Kind.UNHANDLED_CASE:
            return labels["payload_case"] == UNKNOWN_CASE
        target = labels.get("target", "")
        was_silent = self.returned.get(target, inf) < self.seconds
        is_silent = target in self._stale and self.was_heard(target)
        return labels.get("reason") in UNSENT_REASONS and (is_silent or was_silent)

    def _loss(self, kind: Kind, labels: Mapping[str, str], counts: Counter[str]) -> Problem:
        routes = tuple(route for route, _ in counts.most_common() if route)
        amount = str(counts.total()) if "route" in labels else self._amount(counts)
        more, reason = f", {amount} in {self._span}", labels.get("reason", "")
        if kind is Kind.UNHANDLED_CASE:
            return self._unhandled(labels, more)
        if reason == "source_mismatch" and labels["listener"] not in self.program.table.gateways:
            who, routes = self._senders.mismatched(labels["listener"])
            more += f": {who}" if who else ""
        elif reason == "unknown_case":
            more += f": {who}" if (who := self._senders.unknown(labels["listener"])) else ""
        problem = self._problem(kind, labels, more, routes)
        if (target := labels.get("target", "")) in self._stale and reason in UNSENT_REASONS:
            more += f": {target} has not been heard since the router started"
            return problem._replace(more=more, remedy=self._remedy_for_silence(target))
        if kind in DROPS:
            remedies = dict.fromkeys(self._remedy_for_loss(reason, route, target) for route in routes)
            return problem._replace(remedy=" ".join(remedies))
        return problem

    def _unhandled(self, labels: Mapping[str, str], more: str) -> Problem:
        """Return the problem of a payload case that no route accepts from endpoints, with its senders."""
        case = labels["payload_case"]
        routes = [route for route in self.program.table.routes if route.case.value == case]
        topics = list(dict.fromkeys(topic.topic.value for route in routes for topic in route.source_topics))
        if topics:
            more += f": it is accepted only from {'topic' if len(topics) == 1 else 'topics'} {listed(topics)}"
        if senders := self._senders.of(case):
            more += f"{'; ' if topics else ': '}{few(senders)} sent it"
        problem = self._problem(Kind.UNHANDLED_CASE, labels, more, tuple(route.name for route in routes))
        return problem._replace(remedy=_FROM_TOPIC.format_map(labels)) if topics else problem

    def _remedy_for_loss(self, reason: str, route: str, target: str) -> str:
        if reason == "stale" and route in self._from_ros:
            return _STALE_FROM_ROS
        if reason == "send_error" and target in self.program.table.endpoints and not self._senders.host(target):
            return self._remedy_for_silence(target)
        if self._is_on_line(target) and reason in _ON_LINE:
            return _ON_LINE[reason].format(target=target, address=self._senders.host(target))
        return REMEDIES.get(reason, "").format(target=target)

    def _is_on_line(self, target: str) -> bool:
        """Return whether a target is the other end of a serial line."""
        endpoint = self.program.table.endpoints.get(target)
        return endpoint is not None and isinstance(endpoint.address.value, SerialPlace)

    @cached_property
    def _from_ros(self) -> set[str]:
        """The routes whose messages have the time when they were sent."""
        return {route.name for route in self.program.table.routes if route.is_outbound}

    def _drop(self, labels: Mapping[str, str]) -> Kind:
        return Kind.COMMANDS_DROPPED if self._are_commands(labels["route"], labels["target"]) else Kind.MESSAGES_DROPPED

    def _are_commands(self, route: str, target: str) -> bool:
        return self.program.counters.are_commands(route, target)

    def _owner(self, route: str) -> str:
        """Return the gateway of a client's deadman, whose route is called GATEWAY:TOPIC; else the route itself."""
        gateway, _, topic = route.partition(":")
        return gateway if topic and gateway in self.program.table.gateways else route

    def _problem(self, kind: Kind, labels: Mapping[str, str], more: str = "", routes: tuple[str, ...] = ()) -> Problem:
        table, address = self.program.table, ""
        if "listener" in labels and labels["listener"] in table.listeners:
            address = table.listeners[labels["listener"]].bound_to
        elif (endpoint := table.endpoints.get(labels.get("endpoint") or labels.get("destination", ""))) is not None:
            host = self._senders.host(endpoint.name)
            address = self.address_of(endpoint) if "destination" in labels and host else host or "its address"
            if kind is Kind.DEADMAN_CANNOT_SEND and self._is_on_line(endpoint.name):
                return Problem(kind, labels, more, _NO_BRAKE_ON_LINE.format_map({**labels, "address": address}), routes)
        remedy = kind.remedy or REMEDIES.get(labels.get("reason") or labels.get("state", ""), "")
        return Problem(kind, labels, more, remedy.format_map({**labels, "address": address}), routes)
