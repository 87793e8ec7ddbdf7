"""A running router seen from outside: the text of /metrics into rates and rows, one for each route.

Knows the metrics' names from the counters; not where the text comes from (`running_router`), nor who shows the rows
(`live_view`).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from prometheus_client.parser import text_string_to_metric_families

from router.compiler.metrics import INTENDED_REASONS, METRICS
from router.observe.status_numbers import DELIVERED

Labels = tuple[str, ...]
Counts = Mapping[Labels, float]

BUCKETS = "_bucket"
"""Stands behind the name of a histogram. Its values are those of Prometheus: how many were not slower than `le`."""

_LABELS = {metric.name: metric.labels for metric in METRICS}
_LABELS |= {f"{metric.name}{BUCKETS}": (*metric.labels, "le") for metric in METRICS if metric.kind == "histogram"}


_DELIVERED = tuple(metric.removesuffix("_total") for metric in DELIVERED)


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The router's metrics at one time. `at` in seconds of any clock; values by the counters' metric name
    and label values, both as the counters order them. `table_sha256` tells which table it ran, empty where that is not
    told."""

    at: float
    values: Mapping[str, Counts]
    table_sha256: str = ""

    def counts(self, metric: str) -> Counts:
        return self.values.get(metric, {})


@dataclass(frozen=True, slots=True)
class TargetRow:
    """A destination or topic of a route, or the clients of a gateway: delivered messages in all and per second, those
    that were dropped, and withheld ones. Of the dropped, `lost` are those that the table does not want gone.
    """

    name: str
    is_topic: bool
    delivered: int
    rate: float
    dropped: Mapping[str, int]
    filtered: int

    @property
    def lost(self) -> dict[str, int]:
        return unwanted(self.dropped)


@dataclass(frozen=True, slots=True)
class RouteRow:
    """A route or a gateway: messages taken in all and per second, and its targets."""

    route: str
    received: int
    rate: float
    targets: tuple[TargetRow, ...]

    @property
    def dropped(self) -> dict[str, int]:
        """Dropped messages of all targets by reason."""
        total: dict[str, int] = defaultdict(int)
        for target in self.targets:
            for reason, count in target.dropped.items():
                total[reason] += count
        return dict(total)

    @property
    def lost(self) -> dict[str, int]:
        return unwanted(self.dropped)


@dataclass(frozen=True, slots=True)
class View:
    """All routes, in the order of the metrics, and what no route took, by reason."""

    routes: tuple[RouteRow, ...]
    received: int
    rate: float
    rejected: Mapping[str, int]
    kernel_drops: int


def unwanted(reasons: Mapping[str, int]) -> dict[str, int]:
    """Without what the table asks for, such as `max_rate`."""
    return {reason: count for reason, count in reasons.items() if reason not in INTENDED_REASONS}


def parse_metrics(text: str, at: float) -> Snapshot:
    """The router's own series out of the Prometheus text format."""
    values: dict[str, dict[Labels, float]] = defaultdict(dict)
    table_sha256 = ""
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            name = sample.name.removeprefix("router_").removesuffix("_total")
            if name in _LABELS:
                values[name][tuple(sample.labels[label] for label in _LABELS[name])] = sample.value
            elif name == "build_info":
                table_sha256 = sample.labels.get("table_sha256", "")
    return Snapshot(at, values, table_sha256)


def view(before: Snapshot, after: Snapshot) -> View:
    """Totals as of `after`, rates per second since `before`."""
    routes = dict.fromkeys(route for route, _ in after.counts("messages_received"))
    received = _total(after, "datagrams_received")
    return View(
        routes=tuple(_route_row(route, before, after) for route in routes),
        received=received,
        rate=_rate(received, _total(before, "datagrams_received"), before, after),
        rejected=_by_last_label(after.counts("datagrams_rejected")),
        kernel_drops=_total(after, "kernel_drops"),
    )


def _route_row(route: str, before: Snapshot, after: Snapshot) -> RouteRow:
    received = _total(after, "messages_received", route)
    return RouteRow(
        route=route,
        received=received,
        rate=_rate(received, _total(before, "messages_received", route), before, after),
        targets=tuple(_target_row(metric, labels, before, after) for metric, labels in _targets(route, after)),
    )


def _targets(route: str, after: Snapshot) -> Iterator[tuple[str, Labels]]:
    """By the metric that counts what each got. Of a gateway these are messages, and not the packets they went in."""
    is_gateway = any(labels[0] == route for labels in after.counts("messages_sent"))
    for metric in _DELIVERED:
        for labels in after.counts(metric):
            if labels[0] == route and not (is_gateway and metric == "datagrams_sent"):
                yield metric, labels


def _target_row(metric: str, labels: Labels, before: Snapshot, after: Snapshot) -> TargetRow:
    delivered = _total(after, metric, *labels)
    dropped = {key: value for key, value in after.counts("messages_dropped").items() if key[:2] == labels}
    return TargetRow(
        name=labels[1],
        is_topic=metric == "messages_published",
        delivered=delivered,
        rate=_rate(delivered, _total(before, metric, *labels), before, after),
        dropped=_by_last_label(dropped),
        filtered=_total(after, "messages_filtered", *labels),
    )


def _total(snapshot: Snapshot, metric: str, *labels: str) -> int:
    """The sum over all series whose first labels are these."""
    counts = snapshot.counts(metric)
    return int(sum(value for key, value in counts.items() if key[: len(labels)] == labels))


def _rate(now: int, then: int, before: Snapshot, after: Snapshot) -> float:
    """Per second; a router that was started anew counts from zero."""
    seconds = after.at - before.at
    return (now - then if now >= then else now) / seconds if seconds > 0 else 0.0


def _by_last_label(counts: Counts) -> dict[str, int]:
    """Totals by the reason, which is the last label, without those that never happened."""
    total: dict[str, int] = defaultdict(int)
    for labels, value in counts.items():
        if value:
            total[labels[-1]] += int(value)
    return dict(total)
