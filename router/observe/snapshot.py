"""The router's numbers at one time, by metric and label values: for status page, `/diagnostics` and `router top`."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from router.compiler.metrics import METRICS

if TYPE_CHECKING:
    from prometheus_client.metrics_core import Metric as Family

PREFIX = "router_"
"""Of the exported names."""

COLLECTED_AT = "X-Collected-At"
"""Header of /metrics: when the numbers were read, in seconds of the router's wall clock."""

BUCKETS = "_bucket"
"""Suffix of a histogram's name. Its values are cumulative, as in Prometheus: how many were not slower than `le`."""

DELIVERED = ("datagrams_sent", "messages_published", "messages_sent")
"""The metrics that count what targets got; their second label is the target."""

Labels = tuple[str, ...]
Counts = Mapping[Labels, float]

SERIES: Mapping[str, Labels] = {metric.name: metric.labels for metric in METRICS} | {
    f"{metric.name}{BUCKETS}": (*metric.labels, "le") for metric in METRICS if metric.kind == "histogram"
}
"""Labels by the name of the metric, as a snapshot has it: without prefix and `_total`."""

_EXPORTED = {PREFIX + name: name for name in SERIES} | {
    f"{PREFIX}{metric.name}_total": metric.name for metric in METRICS if metric.kind == "counter"
}


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Values by a name of SERIES and label values, in the metric's order. `at`: seconds of any clock."""

    at: float
    values: Mapping[str, Counts]
    _by_first: dict[str, dict[str, dict[Labels, float]]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def counts(self, metric: str) -> Counts:
        return self.values.get(metric, {})

    def of(self, metric: str, first: str = "") -> Counts:
        """The series whose first label is `first`, by their other labels. A metric without labels has one, at `()`."""
        if metric not in self._by_first:
            groups: dict[str, dict[Labels, float]] = defaultdict(dict)
            for labels, value in self.counts(metric).items():
                groups[labels[0] if labels else ""][labels[1:]] = value
            self._by_first[metric] = groups
        return self._by_first[metric].get(first, {})

    def total(self, metric: str, *labels: str) -> int:
        """The sum over all series whose labels begin so."""
        if not labels:
            return int(sum(self.counts(metric).values()))
        first, *others = labels
        series = self.of(metric, first)
        return int(sum(value for rest, value in series.items() if rest[: len(others)] == tuple(others)))


def snapshot(families: Iterable[Family], at: float, metrics: Collection[str] | None = None) -> Snapshot:
    """Read what a collector gives, or the parser of the text format. None: all `metrics`; of others nothing is made."""
    values: dict[str, dict[Labels, float]] = defaultdict(dict)
    for family in families:
        if metrics is not None and family.name.removeprefix(PREFIX) not in metrics:
            continue
        for sample in family.samples:
            if (name := _EXPORTED.get(sample.name)) is not None:
                labels = sample.labels
                values[name][tuple([labels[label] for label in SERIES[name]])] = sample.value
    return Snapshot(at, values)


def parse_metrics(text: str, at: float) -> Snapshot:
    """The snapshot in the text of /metrics. Raises ValueError or KeyError where it is not that of a router."""
    from prometheus_client.parser import text_string_to_metric_families

    return snapshot(text_string_to_metric_families(text), at)
