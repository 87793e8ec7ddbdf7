"""The collector for Prometheus. Nothing here is called per datagram."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from time import sleep

from prometheus_client.metrics_core import InfoMetricFamily
from prometheus_client.metrics_core import Metric as Family
from prometheus_client.registry import Collector
from prometheus_client.samples import Sample

from router.clock import boottime_ns
from router.compiler.metrics import COMMAND, METRICS, Metric
from router.observe.readings import Reading, Readings
from router.observe.snapshot import BUCKETS, PREFIX, Labels

SAMPLES_PER_REST = 16
REST_SECONDS = 1e-4

_EXPORTED_AS = {"time": "gauge", "age": "gauge", "number": "gauge", "level": "gauge", "origin": "gauge"}


class CountersCollector(Collector):
    """Exports all series from the first scrape on, even at 0. `build`: labels of `router_build_info`."""

    def __init__(self, readings: Readings, build: Mapping[str, str], clock_ns: Callable[[], int] = boottime_ns) -> None:
        self._readings = readings
        self._build = build
        self._clock_ns = clock_ns

    def collect(self) -> Iterator[Family]:
        reading = self._readings.read(self._clock_ns())
        for metric in METRICS:
            family = Family(PREFIX + metric.name, metric.help, _EXPORTED_AS.get(metric.kind, metric.kind))
            family.samples = _with_rests(self._samples(metric, reading))  # type: ignore[assignment]  # read once, in order
            yield family
        yield InfoMetricFamily(f"{PREFIX}build", "What is running.", dict(self._build))

    def _samples(self, metric: Metric, reading: Reading) -> Iterator[Sample]:
        name = PREFIX + metric.name
        if metric.kind == "histogram":
            for labels, bounds, counts, total in reading.histograms(metric):
                named = self._named(metric, labels)
                for bound, count in zip(bounds, counts, strict=True):
                    yield Sample(f"{name}{BUCKETS}", {**named, "le": bound}, count)
                yield Sample(f"{name}_count", named, counts[-1])
                yield Sample(f"{name}_sum", named, total)
        else:
            suffix = "_total" if metric.kind == "counter" else ""
            for labels, value in reading[metric.name].items():
                yield Sample(name + suffix, self._named(metric, labels), value)

    def _named(self, metric: Metric, labels: Labels) -> dict[str, str]:
        named = dict(zip(metric.labels, labels, strict=True))
        if metric.tells_commands:
            named[COMMAND] = str(self._readings.counters.are_commands(named["route"], named["target"])).lower()
        return named


def _with_rests(samples: Iterator[Sample]) -> Iterator[Sample]:
    """Pause every SAMPLES_PER_REST samples, so that a scrape does not hold the interpreter lock for its whole 5 ms.

    A thread that needs the lock then usually waits 0.1 ms; without pauses it waits for a whole switch interval.
    """
    for number, sample in enumerate(samples, 1):
        if number % SAMPLES_PER_REST == 0:
            sleep(REST_SECONDS)
        yield sample
