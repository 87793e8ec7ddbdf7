"""What a router counted at two times, found by metric and labels, for diagnostics. Makes no words of it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from router.compiler.program import Program

SEEN = "endpoint_last_seen_timestamp_seconds"
"""The metric that tells when an endpoint last sent."""

METRICS = frozenset(
    {
        "config_last_reload_successful",
        "datagrams_received",
        "datagrams_rejected",
        "datagrams_sent",
        "deadman_active",
        "deadman_datagrams_sent",
        "deadman_send_errors",
        "deadman_trips",
        SEEN,
        "gateway_clients",
        "gateway_topics",
        "kernel_drops",
        "messages_dropped",
        "messages_published",
        "messages_received",
        "messages_sent",
        "mirror_dropped",
        "record_dropped",
    }
)
"""What a Look has to have."""

Rest = tuple[str, ...]
"""The values of a series' labels behind the first."""


class Look:
    """What was counted at one time. `samples` have a metric's name, the values of its labels, and what was counted."""

    def __init__(self, samples: Iterable[tuple[str, Sequence[str], float]]) -> None:
        self._series: dict[str, dict[str, dict[Rest, float]]] = {metric: {} for metric in METRICS}
        for metric, labels, value in samples:
            first, *rest = labels or ("",)
            self._series[metric].setdefault(first, {})[tuple(rest)] = value

    def of(self, metric: str, first: str = "") -> Mapping[Rest, float]:
        """The series whose first label has this value; or the one that has no labels."""
        return self._series[metric].get(first, {})

    def all(self, metric: str) -> Iterator[tuple[Rest, float]]:
        """Every series of a metric, the values of all labels together."""
        return (
            ((first, *rest), value) for first, series in self._series[metric].items() for rest, value in series.items()
        )


@dataclass(frozen=True, slots=True)
class Situation:
    """What is counted now and was before, what lies between in seconds, and for how long each endpoint is silent (ns).

    `host` names this computer.
    """

    program: Program
    now: Look
    before: Look
    seconds: float
    silent: Mapping[str, int]
    host: str

    def count(self, metric: str, *labels: str) -> int:
        """Over all series whose labels begin so."""
        series = self.now.of(metric, *labels[:1])
        return int(sum(value for rest, value in series.items() if rest[: len(labels) - 1] == labels[1:]))

    def second(self, metric: str, value: str) -> int:
        """Over all series whose second label has this value."""
        return int(sum(count for labels, count in self.now.all(metric) if labels[1] == value))

    def counted(self, metric: str, first: str) -> Iterator[tuple[Rest, int]]:
        """The series that are not 0."""
        return ((rest, int(value)) for rest, value in self.now.of(metric, first).items() if value)

    def grown(self, metric: str, first: str = "") -> Iterator[tuple[Rest, int]]:
        """The series that have counted meanwhile, and how much."""
        earlier = self.before.of(metric, first)
        for rest, value in self.now.of(metric, first).items():
            if value > (before := earlier.get(rest, 0)):
                yield rest, int(value - before)
