"""What is wrong with a running router, in words: decided here, and shown by all others.

The status page, `/diagnostics`, `router status`, `router top` and doctor show `Look.problems`. An alert of Prometheus
has the name of its kind; tests compare words, levels and thresholds.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, pairwise
from typing import TYPE_CHECKING

from router.compiler.metrics import INTENDED_REASONS, Mismatch
from router.observe.problems import DROPS, Kind, Problem
from router.observe.snapshot import SERIES, Labels, Snapshot
from router.table.model import ANY, EndpointKind
from router.values import age_text

if TYPE_CHECKING:
    from router.compiler.program import Program

PERIOD = 1.0
"""Seconds between two snapshots."""

WINDOW = 10
"""Seconds: a loss is a problem for so long. One that comes and goes would be overlooked."""

REMEDIES: Mapping[str, str] = {
    "send_error": "The network refuses it, or nobody listens there: check that the receiver runs, and its address.",
    "send_buffer_full": "The network is slower than what is sent: route less to it.",
    "queue_full": "It is more than the `bandwidth`, or a thread is behind: route less to it, or raise the bandwidth.",
    "stale": "It was older than its `ttl`: check the link, and that the clocks of both computers agree.",
    "publish_error": "The ROS middleware refuses it: the log says why.",
    "mapping_error": "The mapping fails on these values, as in a division by zero: `router explain` shows it.",
    "non_finite": "A value is NaN or infinite: check what the sender measures.",
    "too_large": "It is larger than the receiver takes: the log names the field and its bound.",
    "incomplete": "Frames are not complete when their time is up: datagrams are lost on the way.",
    "source_mismatch": "No route takes it from that address: `router tap --only rejected` shows what comes from whom.",
    "unknown_case": "The sender's protos are newer than the router's: update them.",
    "malformed": "They cannot be parsed: check that sender and router have the same protos, and the `framing`.",
    "truncated": "They are longer than the router takes.",
    "no_payload": "They are envelopes whose sender sets no payload: `router tap --only rejected` shows who sends them.",
    "empty": "They have no bytes: `router tap --only rejected` shows who sends them.",
}
"""By the reason of a loss."""

_MORE: Mapping[Kind, str] = {
    Kind.QOS_INCOMPATIBLE: ", {:.0f} of them",
    Kind.GATEWAY_CLIENT_SLOW: " by {:.0f} s",
    Kind.GATEWAY_TOPIC_NOT_SERVED: ", topics not served: {:.0f}",
}
"""By how much a value is too large, where that is of interest."""

_GAUGES = (Kind.LISTENER_WAITING, *_MORE)
_LOSSES = (
    Kind.DEADMAN_CANNOT_SEND,
    *DROPS,
    Kind.KERNEL_DROPS,
    Kind.DATAGRAMS_REJECTED,
    Kind.UNHANDLED_CASE,
    Kind.RECORDING_INCOMPLETE,
)
_NO_LOSS = {*INTENDED_REASONS, "unhandled"}
"""What the table asks for, and what UNHANDLED_CASE says."""

_NAMED = 3
"""Routes that are named in words."""

_OTHER_ADDRESS = (
    "If {sender} is {endpoint}, give it the address {address}, or correct `endpoints` and `router reload`: "
    "`router tap --only rejected` shows what it sends."
)
_ALL_SILENT = "All endpoints are silent: check this computer's network, its cable, the switch, the radio."


@dataclass(frozen=True)
class Look:
    """A router at the time of the last of `snapshots`, of the last WINDOW seconds, oldest first.

    `silence`: for how long each endpoint has been silent, or was not heard yet, s. `standing`: for how long the receive
    thread has made no progress, s. `tripped`: for how long the deadmen that send now have done so, s, by route.
    `mismatches`: who sent in the last seconds what no route takes from them.
    """

    program: Program
    snapshots: Sequence[Snapshot]
    silence: Mapping[str, float]
    standing: float
    tripped: Mapping[str, float]
    mismatches: frozenset[Mismatch] = frozenset()

    @property
    def now(self) -> Snapshot:
        return self.snapshots[-1]

    @property
    def seconds(self) -> float:
        """Between the first and the last snapshot."""
        return max(self.now.at - self.snapshots[0].at, 1e-9)

    def grown(self, metric: str) -> Iterator[tuple[Labels, int]]:
        """The series that have counted in the last seconds, and how much."""
        earlier = self.snapshots[0].counts(metric)
        for labels, value in self.now.counts(metric).items():
            if value > (before := earlier.get(labels, 0)):
                yield labels, int(value - before)

    @cached_property
    def problems(self) -> tuple[Problem, ...]:
        """All that is wrong, in the order of kinds."""
        found = chain(
            self._states(),
            self._silent(),
            self._tripped(),
            self._waiting(),
            *map(self._above, _GAUGES),
            *map(self._lost, _LOSSES),
        )
        rank = {kind: place for place, kind in enumerate(Kind)}
        return tuple(sorted(found, key=lambda problem: rank[problem.kind]))

    @cached_property
    def halted(self) -> frozenset[str]:
        """The routes whose deadman has sent for so long that nobody drives: none of whose commands is refused, and
        which the deadman reaches."""
        failing = {labels[0] for labels, _ in self.grown(Kind.DEADMAN_CANNOT_SEND.metric)}
        for labels, _ in self.grown(Kind.MESSAGES_DROPPED.metric):
            named = dict(zip(SERIES[Kind.MESSAGES_DROPPED.metric], labels, strict=True))
            if named["reason"] not in _NO_LOSS:
                failing.add(named["route"])
        return frozenset(route for route, s in self.tripped.items() if s > Kind.HALTED.threshold) - failing

    @cached_property
    def away(self) -> Mapping[str, Sequence[str]]:
        """By halted route, those who send its commands and are silent because nobody drives. A board is not."""
        endpoints = self.program.table.endpoints
        away = {
            name for name in self._stale if endpoints[name].kind is not EndpointKind.BOARD and self._was_heard(name)
        }
        return {route: sorted(away & self._sources.get(route, set())) for route in sorted(self.halted)}

    @cached_property
    def _sources(self) -> Mapping[str, set[str]]:
        """The endpoints that each route takes messages from."""
        return {route.name: {source.value for source in route.sources} for route in self.program.table.routes}

    @cached_property
    def _limits(self) -> Mapping[str, float]:
        """The `stale_after` of each endpoint that a route takes messages from, s."""
        senders = {name for names in self._sources.values() for name in names}
        return {
            endpoint.name: endpoint.stale_after / 1e9
            for endpoint in self.program.table.endpoints.values()
            if endpoint.stale_after is not None and endpoint.name in senders
        }

    @cached_property
    def _stale(self) -> set[str]:
        return {name for name, limit in self._limits.items() if self.silence.get(name, 0.0) > limit}

    def _was_heard(self, endpoint: str) -> bool:
        return bool(self.now.total(Kind.ENDPOINT_SILENT.metric, endpoint))

    def _states(self) -> Iterator[Problem]:
        if self.standing > Kind.RECEIVE_STUCK.threshold:
            yield self._problem(Kind.RECEIVE_STUCK, {}, f" for {age_text(self.standing)}")
        if not self.now.total(Kind.RELOAD_FAILED.metric):
            yield self._problem(Kind.RELOAD_FAILED, {})
        for (name, mode), connections in self.now.counts(Kind.GATEWAY_DISCONNECTED.metric).items():
            if mode == "client" and not connections:
                yield self._problem(Kind.GATEWAY_DISCONNECTED, {"route": name})

    def _silent(self) -> Iterator[Problem]:
        """Those whose commands a deadman replaces first."""
        silent, away = self._stale, set(chain.from_iterable(self.away.values()))
        held = set(chain.from_iterable(self._sources.get(route, ()) for route in self.tripped))
        for name in sorted(silent - away, key=lambda name: (name not in held, name)):
            kind, more = Kind.ENDPOINT_NEVER_HEARD, ""
            if self._was_heard(name):
                kind, more = Kind.ENDPOINT_SILENT, f" for {age_text(self.silence[name])}"
            routes = tuple(route for route, names in self._sources.items() if name in names and names <= silent)
            problem = self._problem(kind, {"endpoint": name}, more, routes)
            if (sender := self._in_place_of(name)) is not None:
                remedy = _OTHER_ADDRESS.format(endpoint=name, address=self._host(name), sender=sender)
                labels = {"endpoint": name, "sender": sender}
                problem = problem._replace(
                    labels=labels, more=f"{more}, and {sender} sends what it should", remedy=remedy
                )
            elif len(silent) == len(self._limits) > 1:
                problem = problem._replace(remedy=_ALL_SILENT)
            yield problem

    def _expected(self, mismatch: Mismatch) -> list[str]:
        """The endpoints that routes take this payload case from."""
        routes = (route for route in self.program.table.routes if route.case.value == mismatch.payload_case)
        return list(dict.fromkeys(name for route in routes for name in sorted(self._sources[route.name] - {ANY})))

    def _host(self, endpoint: str) -> str:
        return self.program.table.endpoints[endpoint].address.value.host

    def _in_place_of(self, endpoint: str) -> str | None:
        """Another host that sends what only this endpoint should."""
        hosts = (each.host for each in sorted(self.mismatches) if self._expected(each) == [endpoint])
        return next((host for host in hosts if host != self._host(endpoint)), None)

    def _mismatched(self, listener: str) -> tuple[str, tuple[str, ...]]:
        """Who sends to a listener what others should, in words; and the routes that do not take it."""
        found = sorted(each for each in self.mismatches if each.listener == listener and self._expected(each))
        names = {self._host(endpoint.name): f"{endpoint.name}, " for endpoint in self.program.table.endpoints.values()}
        told: dict[str, None] = {}
        for each in found:
            who = f"{names[each.host]}{each.host}," if each.host in names else each.host
            expected = self._expected(each)
            if each.host in map(self._host, expected):
                told[f"{who} sends from another port, or to another listener, than the table says"] = None
            else:
                others = " or ".join(f"{name}, {self._host(name)}," for name in expected)
                told[f"{who} sends what {others} should"] = None
        cases = {each.payload_case for each in found}
        routes = tuple(route.name for route in self.program.table.routes if route.case.value in cases)
        more = f"; and {len(told) - _NAMED} more" if len(told) > _NAMED else ""
        return "; ".join([*told][:_NAMED]) + more, routes

    def _tripped(self) -> Iterator[Problem]:
        """Deadmen that send in place of commands: somebody drove until just now, or nobody drives."""
        for route, seconds in self.tripped.items():
            kind, more = Kind.DEADMAN_ACTIVE, ""
            if route in self.halted:
                kind, more = Kind.HALTED, f" for {age_text(seconds)}"
                if silent := self.away[route]:
                    more += f", and {' and '.join(silent)} {'is' if len(silent) == 1 else 'are'} silent"
            yield self._problem(kind, {"route": route}, more, (self._owner(route),))

    def _waiting(self) -> Iterator[Problem]:
        """In a publish call, or for a thread."""
        stalls = [(each.at, each.counts(Kind.PUBLISH_STALLED.metric)) for each in self.snapshots]
        for topic, seconds in stalls[-1][1].items():
            between = (min(counts.get(topic, 0.0), at - before) for (before, _), (at, counts) in pairwise(stalls))
            stalled = max(seconds, sum(between))
            if stalled > Kind.PUBLISH_STALLED.threshold:
                yield self._problem(Kind.PUBLISH_STALLED, {"topic": topic[0]}, f" for {age_text(stalled)}")
        counts = [snapshot.counts(Kind.MESSAGES_WAITING.metric) for snapshot in self.snapshots]
        waiting = sum(min(each.get(labels, 0.0) for each in counts) for labels in counts[-1])
        if waiting > Kind.MESSAGES_WAITING.threshold:
            yield self._problem(Kind.MESSAGES_WAITING, {}, f", {waiting:.0f} at least")

    def _above(self, kind: Kind) -> Iterator[Problem]:
        for values, value in self.now.counts(kind.metric).items():
            labels = dict(zip(SERIES[kind.metric], values, strict=True))
            if value > kind.threshold and labels.get("state", "not_installed") == "not_installed":
                routes = (self._owner(labels["route"]),) if "route" in labels else ()
                yield self._problem(kind, labels, _MORE.get(kind, "").format(value), routes)

    def _lost(self, kind: Kind) -> Iterator[Problem]:
        """What was lost in the last seconds and is not meant to be, summed over the labels that its words lack."""
        sums: dict[Labels, Counter[str]] = defaultdict(Counter)
        for metric in (kind.metric, *(["mirror_dropped"] if kind is Kind.RECORDING_INCOMPLETE else [])):
            for values, count in self.grown(metric):
                labels = dict(zip(SERIES[metric], values, strict=True))
                if labels.get("reason") not in _NO_LOSS and (kind not in DROPS or kind is self._drop(labels)):
                    route = self._owner(labels.get("route", ""))
                    sums[tuple(labels[label] for label in kind.labels)][route] += count
        for values, counts in sums.items():
            if (count := sum(counts.values())) / self.seconds > kind.threshold:
                labels = dict(zip(kind.labels, values, strict=True))
                routes = tuple(route for route, _ in counts.most_common() if route)
                of = f" of {', '.join(routes[:_NAMED])}" if routes and "route" not in labels else ""
                others = f" and {len(routes) - _NAMED} more routes" if len(routes) > _NAMED else ""
                more = f", {count}{of}{others} in {max(self.seconds, 1):.0f} s"
                if labels.get("reason") == "source_mismatch" and labels["listener"] not in self.program.table.gateways:
                    who, routes = self._mismatched(labels["listener"])
                    more += f": {who}" if who else ""
                yield self._problem(kind, labels, more, routes)

    def _drop(self, labels: Mapping[str, str]) -> Kind:
        are_commands = self.program.counters.are_commands(labels["route"], labels["target"])
        return Kind.COMMANDS_DROPPED if are_commands else Kind.MESSAGES_DROPPED

    def _owner(self, route: str) -> str:
        """The gateway that a client's deadman belongs to, which is called GATEWAY:TOPIC; or the route itself."""
        gateway, _, topic = route.partition(":")
        return gateway if topic and gateway in self.program.table.gateways else route

    def _problem(self, kind: Kind, labels: Mapping[str, str], more: str = "", routes: tuple[str, ...] = ()) -> Problem:
        table, address = self.program.table, ""
        if "listener" in labels and labels["listener"] in table.listeners:
            address = table.listeners[labels["listener"]].bound_to
        elif (endpoint := table.endpoints.get(labels.get("endpoint") or labels.get("destination", ""))) is not None:
            address = str(endpoint.address.value if "destination" in labels else endpoint.address.value.host)
        remedy = kind.remedy or REMEDIES.get(labels.get("reason", ""), "")
        return Problem(kind, labels, more, remedy.format_map({**labels, "address": address}), routes)
