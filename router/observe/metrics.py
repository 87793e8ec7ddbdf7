"""Prometheus: reads the counters' integers when it is asked.

Counting happens elsewhere, in plain lists; nothing here is called per datagram.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import accumulate
from time import sleep

from prometheus_client.metrics_core import InfoMetricFamily
from prometheus_client.metrics_core import Metric as Family
from prometheus_client.registry import Collector
from prometheus_client.samples import Sample

from router.compiler.metrics import HISTOGRAM_BOUNDS_NS, HISTOGRAM_CELLS, METRICS, Counters, Metric
from router.compiler.metrics import metric as metric_named

PREFIX = "router_"

SAMPLES_PER_REST = 16
REST_SECONDS = 1e-4

_EXPORTED_AS = {"time": "gauge", "number": "gauge"}
_BUCKETS = (*(f"{bound / 1e9:g}" for bound in HISTOGRAM_BOUNDS_NS), "+Inf")


Asked = Callable[[], Iterable[tuple[Sequence[str], float]]]
"""Gives the label values, in the metric's order, and the value of each series."""


class CountersCollector(Collector):
    """All series of the counters, each from its first scrape on, at 0 while nothing has happened.

    `counts` has the list of each thread that counts: a counter is their sum, a number or a time the largest of them.
    `asked` has what is asked for at each scrape instead, by metric: label values and the value of each series there is
    then. `build` has the labels of `router_build_info`.
    """

    def __init__(
        self,
        counters: Counters,
        counts: Sequence[list[int]],
        asked: Mapping[str, Asked],
        build: Mapping[str, str],
    ) -> None:
        self._counts = counts
        self._asked = asked
        self._build = InfoMetricFamily(f"{PREFIX}build", "What is running.", dict(build))
        self._slots: dict[str, list[tuple[dict[str, str], int]]] = {metric.name: [] for metric in METRICS}
        for series, index in counters.series():
            if series.part == 0:
                labels = dict(zip(metric_named(series.metric).labels, series.labels, strict=True))
                self._slots[series.metric].append((labels, index))

    def collect(self) -> Iterator[Family]:
        threads = [counts.copy() for counts in self._counts]  # at one instant each: copying holds the interpreter lock
        for metric in METRICS:
            family = Family(PREFIX + metric.name, metric.help, _EXPORTED_AS.get(metric.kind, metric.kind))
            family.samples = _with_rests(self._samples(metric, threads))  # type: ignore[assignment]  # read once, in order
            yield family
        yield self._build

    def _samples(self, metric: Metric, threads: Sequence[list[int]]) -> Iterator[Sample]:
        name = PREFIX + metric.name
        suffix = "_total" if metric.kind == "counter" else ""
        if metric.name in self._asked:
            for values, value in self._asked[metric.name]():
                yield Sample(name + suffix, dict(zip(metric.labels, values, strict=True)), value)
            return
        for labels, index in self._slots[metric.name]:
            if metric.kind == "histogram":
                yield from _histogram(name, labels, [thread[index : index + HISTOGRAM_CELLS] for thread in threads])
            elif metric.kind == "time":
                yield Sample(name, labels, max(thread[index] for thread in threads) / 1e9)
            elif metric.kind == "number":
                yield Sample(name, labels, max(thread[index] for thread in threads))
            else:
                yield Sample(name + suffix, labels, sum(thread[index] for thread in threads))


def _with_rests(samples: Iterator[Sample]) -> Iterator[Sample]:
    """Lets datagrams through while a scrape writes its thousand lines, which would hold the interpreter lock for 5 ms.

    A thread that needs the lock then waits 0.1 ms at most times; without rests it waits a whole switch
    interval, and the receive thread needs it again after each system call.
    """
    for number, sample in enumerate(samples, 1):
        if number % SAMPLES_PER_REST == 0:
            sleep(REST_SECONDS)
        yield sample


def _histogram(name: str, labels: dict[str, str], threads: Iterable[list[int]]) -> Iterator[Sample]:
    *parts, sum_ns = map(sum, zip(*threads, strict=True))
    cumulative = list(accumulate(parts))
    for bound, count in zip(_BUCKETS, cumulative, strict=True):
        yield Sample(f"{name}_bucket", {**labels, "le": bound}, count)
    yield Sample(f"{name}_count", labels, cumulative[-1])
    yield Sample(f"{name}_sum", labels, sum_ns / 1e9)
