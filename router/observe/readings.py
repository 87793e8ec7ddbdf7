"""Reads the values of all series at one moment, by the indexes of their counters.

Values are made for a metric when something asks for it, so a reading costs the same for any number of routes. Nothing
here is called per datagram.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple

from router.compiler.metrics import HISTOGRAM_CELLS, Counters, Metric
from router.compiler.metrics import metric as metric_named
from router.net.addresses import origin_text
from router.observe.snapshot import BUCKETS, SERIES, Counts, Labels

SeriesFunction = Callable[[], Iterable[tuple[Sequence[str], float]]]
"""Returns the label values, in the metric's order, and the value of each current series."""


class Histogram(NamedTuple):
    """`counts` are cumulative and in the order of `bounds`, which are texts in seconds. `total`: the sum, in s."""

    labels: Labels
    bounds: Sequence[str]
    counts: Sequence[int]
    total: float


@dataclass(frozen=True, slots=True)
class Readings:
    """The source of the values of a program's series.

    `totals()` copies the counts, those of all threads together: of a counter or level their sum, of everything else
    their maximum. `computed` has, by metric, functions that are called instead. `known`: since when the table has each
    endpoint (boot clock, ns).
    """

    counters: Counters
    totals: Callable[[], Sequence[int]]
    computed: Mapping[str, SeriesFunction]
    known: Mapping[str, int]

    def read(self, now: int, metrics: Collection[str] = SERIES) -> Reading:
        """Read the values at `now` (boot clock, ns). `metrics`: only these, by their names in SERIES."""
        totals = self.totals()
        computed = {
            metric: {tuple(labels): value for labels, value in series()}
            for metric, series in self.computed.items()
            if metric in metrics
        }
        return Reading(self, now, totals, computed, metrics)


class Reading(Mapping[str, Counts]):
    """The values of all series at one time, by metric. Thread-safe."""

    def __init__(
        self,
        source: Readings,
        now: int,
        totals: Sequence[int],
        computed: Mapping[str, Counts],
        metrics: Collection[str],
    ) -> None:
        self._source = source
        self._now = now
        self._totals = totals
        self._metrics = metrics
        self._values = dict(computed)

    def __iter__(self) -> Iterator[str]:
        return iter(self._metrics)

    def __len__(self) -> int:
        return len(self._metrics)

    def __getitem__(self, name: str) -> Counts:
        if name not in self._values:
            if name not in self._metrics:
                raise KeyError(name)
            self._values[name] = dict(self._buckets(name)) if name.endswith(BUCKETS) else self._series(name)
        return self._values[name]

    def histograms(self, metric: Metric) -> Iterator[Histogram]:
        bounds = (*(f"{each / 1e9:g}" for each in metric.bounds), "+Inf")
        for labels, index in self._source.counters.series_of(metric.name):
            *cells, sum_ns = self._totals[index : index + HISTOGRAM_CELLS]
            yield Histogram(labels, bounds, list(accumulate(cells)), sum_ns / 1e9)

    def _buckets(self, name: str) -> Iterator[tuple[Labels, float]]:
        for labels, bounds, counts, _ in self.histograms(metric_named(name.removesuffix(BUCKETS))):
            yield from (((*labels, bound), count) for bound, count in zip(bounds, counts, strict=True))

    def _series(self, name: str) -> Counts:
        of, totals, now = self._source.counters.series_of, self._totals, self._now
        if name == "endpoint_unheard_seconds":
            unheard = (labels for labels, index in of("endpoint_silence_seconds") if not totals[index])
            return {labels: (now - self._source.known[labels[0]]) / 1e9 for labels in unheard}
        match metric_named(name).kind:
            case "age":
                return {labels: max(now - at, 0) / 1e9 for labels, index in of(name) if (at := totals[index])}
            case "origin":
                return {(*labels, origin_text(at)): 1 for labels, index in of(name) if (at := totals[index])}
            case "time":
                return {labels: totals[index] / 1e9 for labels, index in of(name)}
            case _:
                return {labels: totals[index] for labels, index in of(name)}
