"""What is wrong with a running router, in words: decided here, and shown by all others.

The status page, `/diagnostics`, `router status`, `router top` and doctor show `Look.problems`. An alert of Prometheus
has the name of its kind; tests compare words, levels and thresholds.
"""

from __future__ import annotations

import enum
import string
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import TYPE_CHECKING, Any, NamedTuple

from router.compiler.metrics import INTENDED_REASONS
from router.errors import plural
from router.observe.snapshot import SERIES, Labels, Snapshot
from router.table.model import Endpoint, EndpointKind
from router.values import age_text

if TYPE_CHECKING:
    from router.compiler.program import Program

PERIOD = 1.0
"""Seconds between two snapshots."""

WINDOW = 10
"""Seconds: a loss is a problem for so long. One that comes and goes would be overlooked."""

PAGE = "docs/troubleshooting/alerts.md"
"""It has a section for each kind."""


class Level(enum.Enum):
    """CRITICAL: the rover may not obey. WARNING: something is lost. INFO: something is not as the table has it."""

    CRITICAL = "critical"
    WARNING = "warning"
    INFO = "info"


class Kind(enum.Enum):
    """A kind of problem, by the name of its alert and of its section on PAGE; first those that explain others.

    `words` have labels of `metric`, which is at fault above the `threshold`. Losses are per second.
    """

    level: Level
    words: str
    metric: str
    threshold: float

    def __new__(cls, name: str, level: Level, words: str, metric: str = "", threshold: float = 0.0) -> Kind:
        kind = object.__new__(cls)
        kind._value_ = name
        kind.level, kind.words, kind.metric, kind.threshold = level, words, metric, threshold
        return kind

    ROUTER_DOWN = ("RouterDown", Level.CRITICAL, "no router answers at {instance}")
    RECEIVE_STUCK = ("ReceiveStuck", Level.CRITICAL, "the receive thread is stuck", "", 2.0)
    """Threshold in seconds; without datagrams the thread makes progress each half second."""
    LISTENER_WAITING = (
        "ListenerWaiting",
        Level.CRITICAL,
        "{listener} receives nothing: its address or network interface is not there",
        "listener_waiting",
    )
    DEADMAN_CANNOT_SEND = (
        "DeadmanCannotSend",
        Level.CRITICAL,
        "{destination} does not get what the deadman of {route} sends",
        "deadman_send_errors",
    )
    ENDPOINT_SILENT = (
        "EndpointSilent",
        Level.WARNING,
        "{endpoint} is silent",
        "endpoint_last_seen_timestamp_seconds",
    )
    """The threshold is the endpoint's `stale_after`."""
    DEADMAN_ACTIVE = (
        "DeadmanActive",
        Level.WARNING,
        "commands of {route} stopped coming: its deadman sends in their place",
        "deadman_active",
    )
    PUBLISH_STALLED = (
        "PublishStalled",
        Level.WARNING,
        "publishing on {topic} is stuck in the ROS middleware",
        "publish_stalled_seconds",
        1.0,
    )
    """Threshold in seconds, of all calls together."""
    RELOAD_FAILED = (
        "ReloadFailed",
        Level.WARNING,
        "the last reload failed: the table from before it goes on",
        "config_last_reload_successful",
    )
    MESSAGES_DROPPED = (
        "MessagesDropped",
        Level.WARNING,
        "messages for {target} are dropped: {reason}",
        "messages_dropped",
        0.05,
    )
    MESSAGES_WAITING = (
        "MessagesWaiting",
        Level.WARNING,
        "messages wait for a thread that publishes or sends",
        "messages_waiting",
        20,
    )
    """At all times, of all targets together. A few are there at each look where much is published."""
    KERNEL_DROPS = ("KernelDrops", Level.WARNING, "the kernel drops datagrams of {listener}", "kernel_drops")
    DATAGRAMS_REJECTED = (
        "DatagramsRejected",
        Level.WARNING,
        "{listener} rejects datagrams: {reason}",
        "datagrams_rejected",
        0.05,
    )
    UNHANDLED_CASE = ("UnhandledCase", Level.WARNING, "{payload_case} is received, and has no route", "unhandled")
    QOS_INCOMPATIBLE = (
        "QosIncompatible",
        Level.WARNING,
        "nothing passes between {topic} and peers with another {policy}",
        "qos_incompatible",
    )
    GATEWAY_DISCONNECTED = (
        "GatewayDisconnected",
        Level.WARNING,
        "gateway {route} is not connected to its Zenoh router",
        "gateway_connections",
    )
    RECORDING_INCOMPLETE = (
        "RecordingIncomplete",
        Level.WARNING,
        "recordings or taps lack datagrams",
        "record_dropped",
    )
    ENDPOINT_NEVER_HEARD = ("EndpointNeverHeard", Level.INFO, "{endpoint} was never heard since the router started")
    GATEWAY_CLIENT_SLOW = (
        "GatewayClientSlow",
        Level.INFO,
        "client {client} of {route} is behind",
        "gateway_client_lag_seconds",
        5,
    )
    GATEWAY_TOPIC_NOT_SERVED = (
        "GatewayTopicNotServed",
        Level.INFO,
        "types that {route} would need are not installed",
        "gateway_topics",
    )

    @property
    def labels(self) -> Labels:
        """Those in its words."""
        return tuple(label for _, label, *_ in string.Formatter().parse(self.words) if label)


class Problem(NamedTuple):
    """What is wrong (`words`), with labels of its metric; by how much (`more`), which changes; and what to do.

    `routes`: the routes and gateways whose messages it concerns.
    """

    kind: Kind
    labels: Mapping[str, str]
    more: str = ""
    remedy: str = ""
    routes: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        return self.kind.words.format_map(self.labels)

    @property
    def text(self) -> str:
        return self.words + self.more

    @property
    def page(self) -> str:
        return f"{PAGE}#{self.kind.value.lower()}"

    def json(self) -> dict[str, Any]:
        own = {**self._asdict(), "kind": self.kind.value, "level": self.kind.level.value}
        return {**own, "words": self.words, "page": self.page}

    @classmethod
    def of(cls, read: Mapping[str, Any]) -> Problem:
        """The one with this `json()`. Raises KeyError where it is not."""
        kind = {kind.value: kind for kind in Kind}[read["kind"]]
        labels = {label: str(read["labels"][label]) for label in {*kind.labels, *read["labels"]}}
        return cls(kind, labels, read["more"], read["remedy"], tuple(read["routes"]))


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
    "source_mismatch": "The sender's address is not in the table: `router tap --only rejected` shows it.",
    "unknown_case": "The sender's protos are newer than the router's: update them.",
    "malformed": "They cannot be parsed: check that sender and router have the same protos, and the `framing`.",
    "truncated": "They are longer than the router takes.",
}
"""By the reason of a loss."""

_NAMED = 3
"""Routes that are named in words."""


@dataclass(frozen=True)
class Look:
    """A router at the time of the last of `snapshots`, of the last WINDOW seconds, oldest first.

    `silence`: for how long each endpoint has been silent, or was not heard yet, s. `standing`: for how long the receive
    thread has made no progress, s.
    """

    program: Program
    snapshots: Sequence[Snapshot]
    silence: Mapping[str, float]
    standing: float

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
        groups = (self._receiving(), self._commands(), self._silent(), self._losses(), self._ros(), self._gateways())
        rank = {kind: place for place, kind in enumerate(Kind)}
        return tuple(sorted(chain(*groups), key=lambda problem: rank[problem.kind]))

    def _receiving(self) -> Iterator[Problem]:
        if self.standing > Kind.RECEIVE_STUCK.threshold:
            remedy = "`systemctl restart rover-router`, then report it with its log."
            yield Problem(Kind.RECEIVE_STUCK, {}, f" for {age_text(self.standing)}", remedy)
        for labels, _ in self._above(Kind.LISTENER_WAITING):
            place = self.program.table.listeners[labels["listener"]].bound_to
            remedy = f"It waits for {place}; `ip -br address` shows what there is."
            yield Problem(Kind.LISTENER_WAITING, labels, remedy=remedy)
        if not self.now.total(Kind.RELOAD_FAILED.metric):
            yield Problem(Kind.RELOAD_FAILED, {}, remedy="`router validate` says what is wrong with the changed table.")

    def _commands(self) -> Iterator[Problem]:
        table = self.program.table
        for labels, _, routes in self._lost(Kind.DEADMAN_CANNOT_SEND):
            address = table.endpoints[to].address.value if (to := labels["destination"]) in table.endpoints else to
            remedy = f"Nobody listens at {address}, or the network refuses it. Stop the rover by other means."
            yield Problem(Kind.DEADMAN_CANNOT_SEND, labels, "", remedy, routes)
        for labels, _ in self._above(Kind.DEADMAN_ACTIVE):
            route = labels["route"]
            who = self._commander(route)
            remedy = f"Check that {who} still sends, often enough, and with a clock that agrees with this one."
            yield Problem(Kind.DEADMAN_ACTIVE, labels, "", remedy, (self._owners.get(route, route),))

    def _commander(self, name: str) -> str:
        """Who sends the commands of a deadman's route."""
        for route in self.program.table.routes:
            if route.name == name:
                topics = [f"the publisher of {topic.topic.value}" for topic in route.source_topics]
                return " or ".join([*(source.value for source in route.sources), *topics])
        return f"the client of {self._owners.get(name, name)}"

    @cached_property
    def _owners(self) -> Mapping[str, str]:
        """By the name of a client's deadman: its gateway."""
        return {
            inbound.deadman.route: gateway.settings.name
            for gateway in self.program.gateways
            for inbound in gateway.inbound.values()
            if inbound.deadman is not None
        }

    def _silent(self) -> Iterator[Problem]:
        """Those whose commands a deadman replaces first."""
        routes = self.program.table.routes
        sources = {route.name: {source.value for source in route.sources} for route in routes}
        expected = [each for each in self.program.table.endpoints.values() if self._is_expected(each)]
        silent = [each for each in expected if self.silence.get(each.name, 0.0) > (each.stale_after or 0) / 1e9]
        are_all = len(silent) == len(expected) > 1
        names = {each.name for each in silent}
        active = {route for (route,), is_active in self.now.counts(Kind.DEADMAN_ACTIVE.metric).items() if is_active}
        halting = {name for route in active for name in sources.get(route, ())}
        for each in sorted(silent, key=lambda endpoint: endpoint.name not in halting):
            heard = self.now.total(Kind.ENDPOINT_SILENT.metric, each.name)
            kind, more = Kind.ENDPOINT_NEVER_HEARD, ""
            if heard:
                kind, more = Kind.ENDPOINT_SILENT, f" for {age_text(self.silence[each.name])}"
            concerned = tuple(route for route, all_of in sources.items() if each.name in all_of and all_of <= names)
            remedy = _ALL_SILENT if are_all else _silent_remedy(each)
            yield Problem(kind, {"endpoint": each.name}, more, remedy, concerned)

    def _is_expected(self, endpoint: Endpoint) -> bool:
        """Whether it counts as silent after some time."""
        sends = any(source.value == endpoint.name for route in self.program.table.routes for source in route.sources)
        return sends and endpoint.stale_after is not None

    def _losses(self) -> Iterator[Problem]:
        for labels, count, routes in self._lost(Kind.MESSAGES_DROPPED):
            others = f" and {len(routes) - _NAMED} more routes" if len(routes) > _NAMED else ""
            more = f"{self._in_window(count)}, of {', '.join(routes[:_NAMED])}{others}"
            yield Problem(Kind.MESSAGES_DROPPED, labels, more, REMEDIES.get(labels["reason"], ""), routes)
        for labels, count, _ in self._lost(Kind.DATAGRAMS_REJECTED):
            if labels["reason"] != "unhandled":  # has a kind of its own
                remedy = REMEDIES.get(labels["reason"], "")
                yield Problem(Kind.DATAGRAMS_REJECTED, labels, self._in_window(count), remedy)
        for labels, count, _ in self._lost(Kind.UNHANDLED_CASE):
            remedy = "Write a route for it, or `ignore: reason`; `router tap` shows it."
            yield Problem(Kind.UNHANDLED_CASE, labels, self._in_window(count), remedy)
        for labels, count, _ in self._lost(Kind.KERNEL_DROPS):
            remedy = "Raise its `receive_buffer`, or find what takes the processor: `router top --once --sort rate`."
            yield Problem(Kind.KERNEL_DROPS, labels, self._in_window(count), remedy)
        unrecorded = [*self.grown("record_dropped"), *((("not copied",), n) for _, n in self.grown("mirror_dropped"))]
        for (reason,), count in unrecorded:
            remedy = "The disk is full or too slow, or the computer too busy: `df`, `router doctor`."
            yield Problem(Kind.RECORDING_INCOMPLETE, {}, f"{self._in_window(count)}: {reason}", remedy)
        counts = [snapshot.counts(Kind.MESSAGES_WAITING.metric) for snapshot in self.snapshots]
        waiting = sum(min(each.get(labels, 0.0) for each in counts) for labels in counts[-1])
        if waiting > Kind.MESSAGES_WAITING.threshold:
            remedy = "The computer is overloaded (`router top`), or the ROS middleware holds a thread."
            yield Problem(Kind.MESSAGES_WAITING, {}, f", {waiting:.0f} at least", remedy)

    def _ros(self) -> Iterator[Problem]:
        counts = [snapshot.counts(Kind.PUBLISH_STALLED.metric) for snapshot in self.snapshots]
        for topic, seconds in counts[-1].items():
            stalled = max(seconds, sum(min(each.get(topic, 0.0), PERIOD) for each in counts))
            if stalled > Kind.PUBLISH_STALLED.threshold:
                remedy = "A subscriber may be stuck, or was killed; forwarding and deadmen go on."
                yield Problem(Kind.PUBLISH_STALLED, {"topic": topic[0]}, f" for {age_text(stalled)}", remedy)
        for labels, peers in self._above(Kind.QOS_INCOMPATIBLE):
            remedy = f"`ros2 topic info -v {labels['topic']}` shows theirs, `router explain {labels['route']}` ours."
            more = f": {plural(int(peers), 'peer')}"
            yield Problem(Kind.QOS_INCOMPATIBLE, labels, more, remedy, (labels["route"],))

    def _gateways(self) -> Iterator[Problem]:
        for (name, mode), connections in self.now.counts(Kind.GATEWAY_DISCONNECTED.metric).items():
            if mode == "client" and not connections:
                remedy = "Check that the hub runs, and that `connect` can be reached; the log says why it cannot."
                yield Problem(Kind.GATEWAY_DISCONNECTED, {"route": name}, "", remedy, (name,))
        for labels, lag in self._above(Kind.GATEWAY_CLIENT_SLOW):
            remedy = "It gets the latest values only. Give its gateway smaller `rates`, or `compression`."
            yield Problem(Kind.GATEWAY_CLIENT_SLOW, labels, f" by {age_text(lag)}", remedy, (labels["route"],))
        for labels, topics in self._above(Kind.GATEWAY_TOPIC_NOT_SERVED):
            if labels["state"] == "not_installed":
                name, more = labels["route"], f": {plural(int(topics), 'topic')} not served"
                remedy = f"`router explain {name} --live` names them: source their packages, or exclude them."
                yield Problem(Kind.GATEWAY_TOPIC_NOT_SERVED, {"route": name}, more, remedy, (name,))

    def _above(self, kind: Kind) -> Iterator[tuple[dict[str, str], float]]:
        """The labels of the series above the threshold, with their values."""
        for labels, value in self.now.counts(kind.metric).items():
            if value > kind.threshold:
                yield dict(zip(SERIES[kind.metric], labels, strict=True)), value

    def _lost(self, kind: Kind) -> Iterator[tuple[dict[str, str], int, tuple[str, ...]]]:
        """What was lost in the last seconds and is not meant to be, summed over the labels that its words lack.

        Yields labels, count, and the routes with most of it first.
        """
        sums: dict[Labels, Counter[str]] = defaultdict(Counter)
        for labels, count in self.grown(kind.metric):
            named = dict(zip(SERIES[kind.metric], labels, strict=True))
            if named.get("reason") not in INTENDED_REASONS:
                sums[tuple(named[label] for label in kind.labels)][named.get("route", "")] += count
        for labels, routes in sums.items():
            if (count := sum(routes.values())) / self.seconds > kind.threshold:
                names = tuple(self._owners.get(name, name) for name, _ in routes.most_common() if name)
                yield dict(zip(kind.labels, labels, strict=True)), count, names

    def _in_window(self, count: int) -> str:
        return f", {count} in {max(self.seconds, 1):.0f} s"


_ALL_SILENT = "All endpoints are silent: check this computer's network, its cable, the switch, the radio."


def _silent_remedy(endpoint: Endpoint) -> str:
    address = endpoint.address.value
    is_remote = endpoint.kind is EndpointKind.BASESTATION
    what = "the radio link and the basestation" if is_remote else "power and cable"
    return (
        f"Check {what}: `ping {address.host}`; `tcpdump -n udp and host {address.host}` shows whether anything comes."
    )
