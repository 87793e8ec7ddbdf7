"""The collector for Prometheus, which reads the counters at each scrape. Nothing here is called per datagram."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import accumulate
from time import sleep

from prometheus_client.metrics_core import InfoMetricFamily
from prometheus_client.metrics_core import Metric as Family
from prometheus_client.registry import Collector
from prometheus_client.samples import Sample

from router.clock import boottime_ns
from router.compiler.metrics import COMMAND, HISTOGRAM_CELLS, METRICS, Counters, Metric
from router.compiler.metrics import metric as metric_named
from router.observe.snapshot import BUCKETS, PREFIX

SAMPLES_PER_REST = 16
REST_SECONDS = 1e-4

_EXPORTED_AS = {"time": "gauge", "age": "gauge", "number": "gauge", "level": "gauge"}

SeriesFunction = Callable[[], Iterable[tuple[Sequence[str], float]]]
"""Returns the label values, in the metric's order, and the value of each current series."""


class CountersCollector(Collector):
    """Exports all series of the counters from the first scrape on, even at 0.

    `counts()` copies the list of each counting thread: a counter or level is their sum, everything else their maximum.
    `computed` has, by metric, functions that are called at each scrape instead. `known`: since when the table has each
    endpoint (boot clock, ns). `build`: labels of `router_build_info`.
    """

    def __init__(
        self,
        counters: Counters,
        counts: Callable[[], Sequence[Sequence[int]]],
        computed: Mapping[str, SeriesFunction],
        known: Mapping[str, int],
        build: Mapping[str, str],
        clock_ns: Callable[[], int] = boottime_ns,
    ) -> None:
        self._counts = counts
        self._computed = computed
        self._known = known
        self._clock_ns = clock_ns
        self._build = InfoMetricFamily(f"{PREFIX}build", "What is running.", dict(build))
        self._indexes: dict[str, list[tuple[dict[str, str], int]]] = {metric.name: [] for metric in METRICS}
        for series, index in counters.series():
            metric = metric_named(series.metric)
            labels = dict(zip(metric.labels, series.labels, strict=True))
            if metric.tells_commands:
                labels[COMMAND] = str(counters.are_commands(labels["route"], labels["target"])).lower()
            self._indexes[series.metric].append((labels, index))

    def collect(self) -> Iterator[Family]:
        threads, now = self._counts(), self._clock_ns()
        for metric in METRICS:
            family = Family(PREFIX + metric.name, metric.help, _EXPORTED_AS.get(metric.kind, metric.kind))
            family.samples = _with_rests(self._samples(metric, threads, now))  # type: ignore[assignment]  # read once, in order
            yield family
        yield self._build

    def _samples(self, metric: Metric, threads: Sequence[Sequence[int]], now: int) -> Iterator[Sample]:
        name = PREFIX + metric.name
        suffix = "_total" if metric.kind == "counter" else ""
        if metric.name in self._computed:
            for values, value in self._computed[metric.name]():
                yield Sample(name + suffix, dict(zip(metric.labels, values, strict=True)), value)
        elif metric.name == "endpoint_unheard_seconds":
            for labels, index in self._indexes["endpoint_silence_seconds"]:
                if not any(thread[index] for thread in threads):
                    yield Sample(name, labels, (now - self._known[labels["endpoint"]]) / 1e9)
        elif metric.kind == "histogram":
            for labels, index in self._indexes[metric.name]:
                cells = [thread[index : index + HISTOGRAM_CELLS] for thread in threads]
                yield from _histogram(name, labels, metric.bounds, cells)
        else:
            for labels, index in self._indexes[metric.name]:
                if (found := _value(metric.kind, [thread[index] for thread in threads], now)) is not None:
                    yield Sample(name + suffix, labels, found)


def _value(kind: str, counts: Sequence[int], now: int) -> float | None:
    """Return the value of a series that is no histogram, or None if it does not exist yet."""
    if kind in ("counter", "level"):
        return sum(counts)
    latest = max(counts)
    if kind == "age":
        return max(now - latest, 0) / 1e9 if latest else None
    return latest / 1e9 if kind == "time" else latest


def _with_rests(samples: Iterator[Sample]) -> Iterator[Sample]:
    """Pause every SAMPLES_PER_REST samples, so that a scrape does not hold the interpreter lock for its whole 5 ms.

    A thread that needs the lock then usually waits 0.1 ms; without pauses it waits for a whole switch interval.
    """
    for number, sample in enumerate(samples, 1):
        if number % SAMPLES_PER_REST == 0:
            sleep(REST_SECONDS)
        yield sample


def _histogram(
    name: str, labels: dict[str, str], bounds: Sequence[int], threads: Iterable[Sequence[int]]
) -> Iterator[Sample]:
    *cells, sum_ns = map(sum, zip(*threads, strict=True))
    cumulative = list(accumulate(cells))
    for bound, count in zip((*(f"{each / 1e9:g}" for each in bounds), "+Inf"), cumulative, strict=True):
        yield Sample(f"{name}{BUCKETS}", {**labels, "le": bound}, count)
    yield Sample(f"{name}_count", labels, cumulative[-1])
    yield Sample(f"{name}_sum", labels, sum_ns / 1e9)
