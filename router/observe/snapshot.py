"""Snapshots of all metrics of a router, for the status page, `/diagnostics` and `router top`."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from router.compiler.metrics import METRICS

if TYPE_CHECKING:
    from prometheus_client.metrics_core import Metric as Family

PREFIX = "router_"
"""The prefix of exported names."""

COLLECTED_AT = "X-Collected-At"
"""A header of /metrics: when they were collected, in seconds of the router's boot clock."""

BUCKETS = "_bucket"
"""The suffix of a histogram's name. Its values are cumulative, as in Prometheus: the number at or below `le`."""

DELIVERED = ("datagrams_sent", "messages_published", "messages_sent")
"""The metrics that count deliveries to targets; the second label is the target."""

Labels = tuple[str, ...]
Counts = Mapping[Labels, float]

SERIES: Mapping[str, Labels] = {metric.name: metric.labels for metric in METRICS} | {
    f"{metric.name}{BUCKETS}": (*metric.labels, "le") for metric in METRICS if metric.kind == "histogram"
}
"""The labels of each metric, by its name in snapshots: without prefix and `_total`."""

_EXPORTED = {PREFIX + name: name for name in SERIES} | {
    f"{PREFIX}{metric.name}_total": metric.name for metric in METRICS if metric.kind == "counter"
}


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Values by a name in SERIES and label values, in the metric's order. `at`: seconds of any clock."""

    at: float
    values: Mapping[str, Counts]
    _by_first: dict[str, dict[str, dict[Labels, float]]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def counts(self, metric: str) -> Counts:
        return self.values.get(metric, {})

    def of(self, metric: str, first: str = "") -> Counts:
        """Return the series whose first label is `first`, by their other labels: `()` if there are none."""
        if metric not in self._by_first:
            groups: dict[str, dict[Labels, float]] = defaultdict(dict)
            for labels, value in self.counts(metric).items():
                groups[labels[0] if labels else ""][labels[1:]] = value
            self._by_first[metric] = groups
        return self._by_first[metric].get(first, {})

    def total(self, metric: str, *labels: str) -> int:
        """Return the sum over all series that begin with these labels."""
        if not labels:
            return int(sum(self.counts(metric).values()))
        first, *others = labels
        series = self.of(metric, first)
        return int(sum(value for rest, value in series.items() if rest[: len(others)] == tuple(others)))


def snapshot(families: Iterable[Family], at: float) -> Snapshot:
    """Make a snapshot of the output of a collector or of the text format's parser."""
    values: dict[str, dict[Labels, float]] = defaultdict(dict)
    for family in families:
        for sample in family.samples:
            if (name := _EXPORTED.get(sample.name)) is not None:
                labels = sample.labels
                values[name][tuple([labels[label] for label in SERIES[name]])] = sample.value
    return Snapshot(at, values)


def parse_metrics(text: str, at: float) -> Snapshot:
    """Parse the text of /metrics. Raises ValueError or KeyError if it is not the text of a router."""
    from prometheus_client.parser import text_string_to_metric_families

    return snapshot(text_string_to_metric_families(text), at)


def quantile(counts: Mapping[float, float], part: float) -> float | None:
    """Return the quantile `part` of a histogram, interpolated in its bucket. `counts`: values up to each bound.

    `inf` if it is beyond the last bound, None if there are no values.
    """
    bounds = sorted(counts)
    if not bounds or counts[bounds[-1]] <= 0:
        return None
    rank = part * counts[bounds[-1]]
    lower, below = 0.0, 0.0
    for bound in bounds:
        if counts[bound] >= rank:
            inside = counts[bound] - below
            return lower + (bound - lower) * (rank - below) / inside if math.isfinite(bound) and inside else bound
        lower, below = bound, counts[bound]
    return math.inf
