"""The counters: every series that the router exports, and its index in a flat list of integers.

The metrics are declared once, in `METRICS`, for the collector, the documentation and the compiler. A thread counts with
`counts[index] += 1` in its own list.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from router.declared import HISTOGRAM_BOUNDS, MOST_COUNTERS
from router.errors import ConfigurationError


@dataclass(frozen=True, slots=True)
class Metric:
    """One metric. `kind` is counter, histogram, number, level, time (nanoseconds in the counters, seconds exported), or
    age: the boot clock (ns) at an event in the counters, the seconds since then exported, no series before it. Of the
    kind origin, the counter has an address and a port, which are exported as the last label; no series before that.

    One thread sets a number, a time, an age or an origin; several add to a level and subtract from it. A metric that
    `tells_commands` is also exported with the label COMMAND, which follows from its `route` and `target`. `bounds` (ns)
    are a histogram's.
    """

    name: str
    kind: str
    labels: tuple[str, ...]
    help: str
    tells_commands: bool = False
    bounds: tuple[int, ...] = ()

    @property
    def exported_labels(self) -> tuple[str, ...]:
        return (*self.labels, COMMAND) if self.tells_commands else self.labels


COMMAND = "command"
"""The label that is `true` for commands, else `false`."""


LATENCY_BOUNDS_NS = tuple(us * 1000 for us in (10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000, 20_000, 50_000))
STOPPING_BOUNDS_NS = tuple(
    ms * 1_000_000 for ms in (20, 50, 100, 200, 500, 1000, 2000, 3000, 5000, 10_000, 20_000, 30_000)
)
"""Bounds of histograms, as in `native/counters.h`."""
CALL_BOUNDS_NS = tuple(ms * 1_000_000 for ms in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000))
"""Bounds of the histogram of calls, as many as the others have."""

HISTOGRAM_CELLS = HISTOGRAM_BOUNDS + 2
"""Consecutive indexes of a histogram: one for each bound, one for everything slower, and the sum (ns)."""

METRICS = (
    Metric("datagrams_received", "counter", ("listener",), "Datagrams taken from the listener's socket."),
    Metric("received_bytes", "counter", ("listener",), "Bytes of the datagrams taken from the listener's socket."),
    Metric("kernel_drops", "counter", ("listener",), "Datagrams that the kernel dropped before the router saw them."),
    Metric(
        "groups_not_joined",
        "number",
        ("listener",),
        "Multicast groups that it has not joined: their network interface or a route to them is missing.",
    ),
    Metric("listener_waiting", "number", ("listener",), "1 while its address or network interface is missing."),
    Metric("link_up", "number", ("endpoint",), "1 while the serial line or TCP connection to it is open."),
    Metric("link_openings", "counter", ("endpoint",), "How often the serial line or TCP connection to it was opened."),
    Metric("datagrams_padded", "counter", ("listener",), "Datagrams whose trailing zeros were restored or removed."),
    Metric(
        "superseded_members",
        "counter",
        ("listener",),
        "Payloads that another one in the same datagram replaced, as in protobuf: the last one counts.",
    ),
    Metric("datagrams_rejected", "counter", ("listener", "reason"), "Datagrams that no route accepted, by reason."),
    Metric("unhandled", "counter", ("payload_case",), "Datagrams of a payload case without a route."),
    Metric("messages_received", "counter", ("route", "source"), "Messages that a route accepted, by source."),
    Metric("datagrams_sent", "counter", ("route", "destination"), "Datagrams handed to the kernel."),
    Metric("sent_bytes", "counter", ("route", "destination"), "Bytes of the datagrams handed to the kernel."),
    Metric("messages_published", "counter", ("route", "topic"), "Messages handed to the ROS middleware."),
    Metric("messages_sent", "counter", ("route", "target"), "ROS messages that a gateway handed to its clients."),
    Metric(
        "messages_dropped",
        "counter",
        ("route", "target", "reason"),
        "Messages not delivered to a target, by reason.",
        tells_commands=True,
    ),
    Metric(
        "messages_filtered", "counter", ("route", "target"), "Messages withheld by `when`, or without a subscriber."
    ),
    Metric("messages_collected", "counter", ("route", "target"), "Messages that joined an open frame."),
    Metric(
        "messages_split",
        "counter",
        ("route", "target"),
        "Messages that the `for_each` of a topic adds: the elements of each list, except the first.",
    ),
    Metric("messages_waiting", "level", ("route", "target"), "Messages queued between two threads of the router."),
    Metric(
        "publish_stalled_seconds",
        "number",
        ("topic",),
        "How long the current publish call has been in the ROS middleware; 0 below 10 ms.",
    ),
    Metric(
        "route_duration_seconds",
        "histogram",
        ("route",),
        "Time from receipt of a message until it is forwarded, and delivered or queued for all other targets.",
        bounds=LATENCY_BOUNDS_NS,
    ),
    Metric(
        "route_silence_seconds",
        "age",
        ("route",),
        "How long ago the route last accepted a message; no series until it has accepted one.",
    ),
    Metric(
        "endpoint_silence_seconds",
        "age",
        ("endpoint",),
        "How long ago the endpoint last sent; no series until it has sent.",
    ),
    Metric(
        "endpoint_heard_seconds",
        "age",
        ("endpoint",),
        "How long ago the endpoint was first heard since its last silence; no series until it has sent.",
    ),
    Metric("endpoint_unresolved", "number", ("endpoint",), "1 while its host name is not resolved."),
    Metric(
        "endpoint_learned",
        "origin",
        ("endpoint", "address"),
        "1 for the address and port that were learned; no series before that.",
    ),
    Metric("endpoint_silences", "counter", ("endpoint",), "How often the endpoint was heard again after a silence."),
    Metric("endpoint_last_silence_seconds", "time", ("endpoint",), "How long the last such silence was."),
    Metric(
        "endpoint_unheard_seconds",
        "number",
        ("endpoint",),
        "How long the endpoint has not been heard since the router started; no series once it has sent.",
    ),
    Metric(
        "endpoint_stale_after_seconds", "number", ("endpoint", "kind"), "Silence after which the endpoint is stale."
    ),
    Metric("deadman_active", "number", ("route",), "1 while the route's deadman sends in place of its commands."),
    Metric("deadman_trips", "counter", ("route",), "How often commands stopped coming."),
    Metric(
        "deadman_datagrams_sent",
        "counter",
        ("route", "destination"),
        "Datagrams that the deadman sent, including those at the start.",
    ),
    Metric("deadman_send_errors", "counter", ("route", "destination"), "Datagrams that the deadman could not send."),
    Metric(
        "deadman_disobeyed",
        "number",
        ("route", "endpoint"),
        "1 while the deadman sends and the endpoint does not show within the time of `obeyed` that it has stopped.",
    ),
    Metric(
        "deadman_stopping_seconds",
        "histogram",
        ("route", "endpoint"),
        "Time from the first brake until the endpoint showed that it had stopped.",
        bounds=STOPPING_BOUNDS_NS,
    ),
    Metric("state", "level", ("state",), "The value of a state: an integer, also of a bool or an enum."),
    Metric("state_text", "number", ("state", "text"), "1 for the present value of a state that is a text."),
    Metric("state_changes", "counter", ("state",), "How often the value of a state changed, also by expiring."),
    Metric(
        "state_set_seconds",
        "age",
        ("state", "source"),
        "How long ago a message of the source that set the state arrived; no series until one has.",
    ),
    Metric("service_calls", "counter", ("service", "outcome"), "Calls of a service that have ended, by outcome."),
    Metric("service_calls_open", "number", ("service",), "Calls that currently wait for a reply."),
    Metric(
        "service_call_seconds",
        "histogram",
        ("service",),
        "Time from taking a call until its response, also without a reply.",
        bounds=CALL_BOUNDS_NS,
    ),
    Metric("service_retries", "counter", ("service",), "Requests sent again, because no reply came in time."),
    Metric("service_replies_unmatched", "counter", ("service",), "Replies that no call was waiting for."),
    Metric("gateway_clients", "number", ("route",), "Current clients of a gateway."),
    Metric(
        "gateway_client_clock_ahead", "counter", ("route",), "Messages of clients whose clock is ahead of the router's."
    ),
    Metric("gateway_key_conflicts", "counter", ("route",), "How often another gateway used the same Zenoh key."),
    Metric("gateway_connections", "number", ("route", "mode"), "Zenoh routers and peers that are currently connected."),
    Metric(
        "gateway_topics", "number", ("route", "state"), "Topics that currently match a gateway's patterns, by state."
    ),
    Metric("gateway_client_lag_seconds", "number", ("route", "client"), "How long a client has been behind."),
    Metric("gateway_client_sent", "counter", ("route", "client"), "Frames handed to a client since it connected."),
    Metric("gateway_client_dropped", "counter", ("route", "client"), "Frames of the client that newer ones replaced."),
    Metric(
        "client_messages_dropped",
        "counter",
        ("route", "reason"),
        "Messages not delivered to single clients, by reason.",
    ),
    Metric(
        "connections_refused",
        "counter",
        ("server",),
        "Connections from addresses outside the server's `from`: http, foxglove, or a gateway.",
    ),
    Metric("mirror_dropped", "counter", (), "Datagrams and actions that recordings and taps missed."),
    Metric("recorded_datagrams", "counter", (), "Datagrams written to a recording."),
    Metric("recorded_bytes", "counter", (), "Bytes of the datagrams written to a recording."),
    Metric("record_dropped", "counter", ("reason",), "Datagrams missing from a recording, by reason."),
    Metric("recordings_unsaved", "number", ("reason",), "Recordings of stops in memory that the disk does not accept."),
    Metric("recordings_lost", "counter", (), "Recordings of stops that were never written."),
    Metric("config_reloads", "counter", ("result",), "Reloads of the table, by result."),
    Metric("config_last_reload_successful", "number", (), "1 unless the last reload failed."),
    Metric("config_last_reload_timestamp_seconds", "time", (), "When the running table was loaded."),
    Metric(
        "qos_incompatible",
        "number",
        ("route", "topic", "policy"),
        "Peers that currently cannot connect because of their QoS.",
    ),
    Metric(
        "type_incompatible",
        "number",
        ("route", "topic", "peer", "type", COMMAND),
        "Publishers and subscribers of a topic that currently have another type than the table.",
    ),
    Metric("topic_subscribers", "number", ("topic",), "Subscribers that currently get what the router publishes."),
    Metric(
        "other_routers",
        "number",
        ("host", "process", "shares", "name"),
        "1 for each topic from which another router also takes messages, and if its node has the same name.",
    ),
    Metric("node_namesakes", "number", ("node",), "Other nodes with the name of the router's node, without routers."),
)

ENDPOINT_METRICS = (
    "endpoint_silence_seconds",
    "endpoint_heard_seconds",
    "endpoint_silences",
    "endpoint_last_silence_seconds",
)
"""The metrics that the receive thread writes for each endpoint."""

REJECT_REASONS: Mapping[str, str] = {
    "truncated": "longer than the router accepts",
    "empty": "no bytes",
    "malformed": "not an envelope, or its payload is not of its type",
    "no_payload": "an envelope without a payload",
    "unknown_case": "a field number, or the name of a message, that the envelope does not have",
    "unhandled": "a payload case without a route",
    "ignored": "a payload case that the table ignores",
    "source_mismatch": "from an address that is not a source of the route, or on the wrong listener",
    "bad_frame": "bytes of a serial line or TCP connection that are no frame, or a frame that is too long",
    "bad_checksum": "a frame whose bytes were changed on the way",
}
"""Reasons why no route accepted a datagram or frame, with their meaning."""

DROP_REASONS: Mapping[str, str] = {
    "mapping_error": "a mapping failed for these values, for example by division by zero",
    "non_finite": "NaN or infinity where an integer or a time is needed, or for a board",
    "too_large": "the envelope, an integer, a text or a list is larger than the board accepts",
    "stale": "older than `ttl`",
    "rate_limited": "more often than `max_rate`; not logged, because the table asks for it",
    "queue_full": "the queue was full, because the endpoint's `bandwidth` was too small or a thread was behind",
    "send_buffer_full": "the kernel's send buffer was full",
    "send_error": "the network refused it, or nobody listens there",
    "publish_error": "the ROS middleware rejected it",
    "incomplete": "a frame that was not complete within its timeout, or for which there was no room",
    "superseded": "a command was held until a newer one of another route, which disarms its deadman, was sent",
    "missing_field": "a field is missing that the board's protos declare as `required`",
    "out_of_order": "not newer, by the route's `order`, than what the same sender had sent before",
    "loop": "it came from this router: stays 0, because tables with loops are rejected",
}
"""Reasons why a message was not delivered to a target, with their meaning."""

GATEWAY_REJECT_REASONS: Mapping[str, str] = {
    "too_large": "longer than the gateway accepts, before or after decompression",
    "malformed": "not a packet or document in the gateway's format, or not JSON",
    "source_mismatch": "not from the host that the gateway sends to",
    "not_allowed": "a topic or service that is not in `inbound`",
    "wrong_type": "not the type that `inbound` declares",
    "invalid": "a field is missing, unknown, of another type or out of range",
    "premature": "its `time` is further in the future than `max_lead`",
    "rate_limited": "schemas were requested too often, or a service was called by a client that was behind",
}
"""Reasons why a gateway rejected a client's message, with their meaning."""

GATEWAY_DROP_REASONS: Mapping[str, str] = {
    "mapping_error": "not a message of the topic's type, or text that is not UTF-8",
    "too_large": "longer than `max_message`, or than a datagram",
    "overloaded": "it arrived while earlier ones were still being converted",
}
"""Reasons why a gateway delivered a ROS message to no client, with their meaning."""

INTENDED_REASONS = frozenset({"rate_limited", "ignored"})
"""Drops and rejections that the table requests: they are not reported."""

UNSENT_REASONS = ("send_error", "send_buffer_full", "queue_full")
"""The DROP_REASONS that follow when an endpoint does not answer."""

INBOUND_DROP_REASONS = ("stale", "rate_limited", "publish_error")
"""The DROP_REASONS that apply to messages of clients."""

CALL_OUTCOMES: Mapping[str, str] = {
    "answered": "the endpoint replied; a ROS server that is called responded",
    "timed_out": "no reply came within `timeout`, after all `retries`",
    "busy": "an earlier call was open, and without `match` there is one at a time; to a ROS server, 64 were open",
    "unsent": "the endpoint could not be sent to, or there was no ROS server",
    "refused": "the call was older than `ttl`, beyond `max_rate`, or its values or those of the reply do not fit",
    "cancelled": "a reload or the stop of the router ended it, or its client left the gateway",
}
"""How a call of a service ends, with the meaning."""

TOPIC_STATES: Mapping[str, str] = {
    "served": "a client gets it",
    "several_types": "served with the table's type, or else with the one that most of its publishers use",
    "not_installed": "not served: its type is not installed here",
    "refused": "not served: the router uses the topic with another type, or ROS refuses the subscription",
    "over_limit": "not served: `max_topics` others are",
}
"""States of a topic that a gateway's patterns match."""

SERVED_STATES = frozenset({"served", "several_types"})
"""The TOPIC_STATES in which clients get the topic."""

PUBLISHER, SUBSCRIBER = "publisher", "subscriber"
"""Values of the label `peer`: an endpoint of a topic that is not the router's."""


def only(peer: str, type_name: str) -> str:
    """Say why nothing passes between the router, which has a topic as this type, and a peer of another type."""
    return f"only {type_name} is {'received' if peer == PUBLISHER else 'published'}"


CLIENT_DROP_REASONS: Mapping[str, str] = {
    "superseded": "a newer value of the topic took its place, because the client is slow",
    "send_error": "the network refused it",
    "left": "it was queued for a client that disconnected",
}
"""Reasons why a message was not delivered to one client of a gateway, with their meaning."""

RECORD_DROP_REASONS: Mapping[str, str] = {
    "overflow": "the disk was slower than the network for longer than the buffer lasts",
    "write_error": "the file could not be written, for example because the disk is full, or the router failed",
}
"""Reasons why a datagram is missing from a recording, with their meaning."""

UNSAVED_REASONS: Mapping[str, str] = {
    "disk_full": "the disk or the user's quota is full",
    "read_only": "the disk is mounted read-only",
    "no_permission": "the router's user may not write there",
    "disk_error": "another error of the disk, which the log names",
}
"""Reasons why the recording of a stop is not on the disk yet, with their meaning."""

RELOAD_RESULTS: Mapping[str, str] = {
    "ok": "the new table is running",
    "invalid": "the table has errors, or changes something that needs a restart",
    "failed": "something that it names cannot be opened",
}
"""Results of a reload, with their meaning. Unless the result is ok, the old table keeps running."""

STARTS: Mapping[str, str] = {
    "kept": "it forwarded with a kept program while the table was compiled",
    "compiled": "there was no kept program for this command line, or `--no-cache`: the table was compiled first",
    "refused": "a kept program was rejected, and the log says why: the table was compiled first",
    "replaced": "it forwarded with a kept program until an input turned out to have changed",
}
"""Ways in which a router can start, with their meaning."""

SHARES_NODE, SHARES_TOPIC = "node", "topic"
"""Values of the label `shares`: what another router has in common with this one."""

CLIENTS = "clients"
"""The `target` and `source` label of a gateway's clients."""

QOS_POLICIES = ("reliability", "durability", "deadline", "liveliness")
"""The policies that can make a publisher and a subscription incompatible."""

UNKNOWN_CASE = "unknown"
"""The `payload_case` label of a field number or a name that the envelope does not have."""


class Series(NamedTuple):
    """A metric with its label values, in the metric's order."""

    metric: str
    labels: tuple[str, ...]


class Mismatch(NamedTuple):
    """A datagram from a host that is not a source of its payload case.

    `payload_case` may have no route for datagrams at all, or be a field that the envelope does not have: `field 77`.
    """

    listener: str
    host: str
    payload_case: str


@dataclass(frozen=True, slots=True)
class Report:
    """A loss. `kind` is `drop` (for one target), `reject` (of a whole datagram), `supersede` (of a payload that a later
    one in its datagram replaces), `deadman` (of its own datagram), `call` (of a service, without a reply) or `reply`
    (that no call waits for).

    `place` is the route, the listener for a reject or supersede, which have an empty `target`, or the service for a
    call or reply. `times` is the number of such losses since the last report. `mismatch` is set if no route accepts
    this payload case from there.
    """

    kind: str
    place: str
    target: str
    reason: str
    error: BaseException | None = None
    detail: str = ""
    times: int = 1
    mismatch: Mismatch | None = None


@dataclass(frozen=True, slots=True)
class Answer:
    """Whether an endpoint obeys the brake of a route's deadman, `after` ns from when the deadman tripped."""

    route: str
    endpoint: str
    obeys: bool
    after: int


@dataclass(frozen=True, slots=True)
class Evidence:
    """A datagram that shows that an endpoint does not obey the brake of a route's deadman, or not yet."""

    route: str
    endpoint: str
    data: bytes


@dataclass(slots=True)
class Counters:
    """The index of each series in the threads' lists of integers.

    Counters may continue those of an earlier program (`continued`): common series keep their indexes. Series that only
    the earlier program had are no longer current, but keep their indexes until `settle` frees them.
    """

    _indexes: dict[str, dict[tuple[str, ...], int]] = field(default_factory=dict)
    """The first index of each series, by metric and labels."""
    _current: set[Series] = field(default_factory=set)
    _free: dict[int, list[int]] = field(default_factory=dict)  # first indexes of free runs, by length
    _size: int = 0
    _commanded: dict[tuple[str, str], bool] = field(default_factory=dict)  # by route and target, also of earlier ones

    def continued(self) -> Counters:
        """Return counters for the next program, in which no series is current yet. These stay unchanged."""
        return Counters(
            {metric: indexes.copy() for metric, indexes in self._indexes.items()},
            set(),
            {length: starts.copy() for length, starts in self._free.items()},
            self._size,
            self._commanded.copy(),
        )

    def set_commands(self, route: str, target: str, *, are_commands: bool) -> None:
        """Set whether a target of a route receives commands."""
        self._commanded[route, target] = are_commands

    def are_commands(self, route: str, target: str) -> bool:
        return self._commanded.get((route, target), False)

    def index(self, metric: str, *labels: str) -> int:
        """Return the first index of a series, which is current from now on."""
        self._current.add(Series(metric, labels))
        index = self._indexes.get(metric, {}).get(labels)
        return self._open(metric, labels) if index is None else index

    def _open(self, metric: str, labels: tuple[str, ...]) -> int:
        declared = _BY_NAME[metric]
        counted = declared.labels[:-1] if declared.kind == "origin" else declared.labels
        if len(labels) != len(counted):
            raise ValueError(f"{metric} has the labels {counted}, not {list(labels)}")
        length = _length_of(declared)
        if free := self._free.get(length):
            start = free.pop()
        else:
            start = self._size
            self._size += length
            if self._size > MOST_COUNTERS:
                raise ConfigurationError(
                    f"the table needs more than {MOST_COUNTERS} counters", "split it: run two routers"
                )
        self._indexes.setdefault(metric, {})[labels] = start
        return start

    @property
    def size(self) -> int:
        """The length of a list of counts."""
        return self._size

    def series(self) -> Iterator[tuple[Series, int]]:
        """Yield every series with its first index, also those of earlier programs that have counted something."""
        for metric in self._indexes:
            for labels, index in self.series_of(metric):
                yield Series(metric, labels), index

    def series_of(self, metric: str) -> list[tuple[tuple[str, ...], int]]:
        """Return the series of a metric: labels and first index. Thread-safe."""
        return list(self._indexes.get(metric, {}).items())

    def latest(self) -> bytes:
        """Return a byte for each index: 0 if the counts of all threads add up, 1 if the largest one is the value."""
        marks = bytearray(self._size)
        for metric in METRICS:
            if metric.kind not in _ADDED:
                for _, index in self.series_of(metric.name):
                    marks[index] = 1
        return bytes(marks)

    def indexes(self) -> list[tuple[tuple[str, ...], int]]:
        """Return the first index of every series, by metric and labels. `Counters.of` makes equal counters."""
        return [((metric, *labels), index) for (metric, labels), index in self.series()]

    @classmethod
    def of(cls, indexes: Iterable[tuple[tuple[str, ...], int]], size: int) -> Counters:
        """Return counters with these indexes, none of which is current yet."""
        made: dict[str, dict[tuple[str, ...], int]] = {}
        for (metric, *labels), index in indexes:
            made.setdefault(metric, {})[tuple(labels)] = index
        return cls(made, _size=size)

    def new_runs(self, earlier: Counters) -> Iterator[slice]:
        """Yield the indexes of each series that `earlier` lacks. These counters must continue `earlier`."""
        for metric, indexes in self._indexes.items():
            for labels in indexes.keys() - earlier._indexes.get(metric, {}).keys():
                yield self._run(metric, labels)

    def _run(self, metric: str, labels: tuple[str, ...]) -> slice:
        start = self._indexes[metric][labels]
        return slice(start, start + _length_of(_BY_NAME[metric]))

    def fresh_counts(self) -> list[int]:
        """Return a list of zeros, one for each index, for one thread to own."""
        return [0] * self._size

    def grow(self, counts: list[int]) -> None:
        """Extend a thread's list with zeros, in place, if it was made for fewer series."""
        if len(counts) < self._size:
            counts.extend([0] * (self._size - len(counts)))

    def settle(self, threads: Iterable[list[int]]) -> None:
        """Free the indexes of series that are no longer current, given the lists of all threads.

        Call this when no thread uses them any more. Counters and histograms that have counted something stay, so that
        totals never decrease.
        """
        lists = list(threads)
        for metric, labels in [series for series, _ in self.series() if series not in self._current]:
            run = self._run(metric, labels)
            if _BY_NAME[metric].kind in _COUNTED and any(any(counts[run]) for counts in lists):
                continue
            length = run.stop - run.start
            for counts in lists:
                counts[run] = [0] * length
            del self._indexes[metric][labels]
            self._free.setdefault(length, []).append(run.start)


_COUNTED = ("counter", "histogram")
_ADDED = (*_COUNTED, "level")


def _length_of(metric: Metric) -> int:
    return HISTOGRAM_CELLS if metric.kind == "histogram" else 1


_BY_NAME = {metric.name: metric for metric in METRICS}


def metric(name: str) -> Metric:
    return _BY_NAME[name]
