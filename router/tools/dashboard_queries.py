"""PromQL for the series of one program. Refuses to ask for series that a router of it would not have.

Knows no panel. `$instance` and `$__rate_interval` are for Grafana to fill in: the router that is chosen, and a time
that no two scrapes are further apart than.
"""

from __future__ import annotations

import json

from router.compiler.metrics import metric as metric_named
from router.compiler.program import Program

INTERVAL = "$__rate_interval"


class Series:
    """What the counters of `program` have, as selectors."""

    def __init__(self, program: Program) -> None:
        named = ((each.metric, each.labels) for each, _ in program.counters.series() if each.part == 0)
        self._series = [
            (metric, dict(zip(metric_named(metric).labels, values, strict=True))) for metric, values in named
        ]

    def has(self, metric: str, **labels: str) -> bool:
        """Whether there is a series of the metric that has these labels."""
        return any(name == metric and labels.items() <= found.items() for name, found in self._series)

    def rate(self, metric: str, by: str = "", **labels: str) -> str:
        """Of counters, per second: one series for each value of the label `by`, or one."""
        return f"sum{f' by ({by})' if by else ''} (rate({self.of(metric, **labels)}[{INTERVAL}]))"

    def seconds_since(self, metric: str, **labels: str) -> str:
        """Of times, up to the scrape, so that it does not grow in between; what never happened gives no series.

        A scrape has the time at which it began: what happened before the router answered it is 0 s ago.
        """
        return f"clamp_min(timestamp({self.of(metric, **labels)}) - ({self.of(metric, **labels)} > 0), 0)"

    def buckets(self, metric: str, **labels: str) -> str:
        """Of histograms: how many fell under each bound within a step of the panel."""
        return f"sum by (le) (increase({self._selected(metric, '_bucket', labels)}[{INTERVAL}]))"

    def quantile(self, share: float, metric: str, **labels: str) -> str:
        """Of histograms: what that share of the values is not above, over all other labels."""
        rate = f"sum by (le) (rate({self._selected(metric, '_bucket', labels)}[{INTERVAL}]))"
        return f"histogram_quantile({share:g}, {rate})"

    def of(self, metric: str, **labels: str) -> str:
        """A selector. Raises ValueError where nothing has these labels."""
        return self._selected(metric, "_total" if metric_named(metric).kind == "counter" else "", labels)

    def _selected(self, metric: str, suffix: str, labels: dict[str, str]) -> str:
        if not self.has(metric, **labels):
            raise ValueError(f"there is no series of {metric} with {labels}")
        return selector(f"router_{metric}{suffix}", **labels)


def selector(name: str, **labels: str) -> str:
    """Of any metric, of the router that is chosen."""
    matchers = ['instance="$instance"', *(f"{label}={json.dumps(value)}" for label, value in labels.items())]
    return f"{name}{{{', '.join(matchers)}}}"
