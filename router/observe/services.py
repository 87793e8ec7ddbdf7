"""The calls of each service of a running table, for the status page, `router status` and `router top`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from router.observe.snapshot import Snapshot


METRICS = frozenset({"service_calls", "service_calls_open", "service_call_seconds_bucket"})
"""What `service_readings` needs of a snapshot."""


@dataclass(frozen=True, slots=True)
class ServiceReading:
    """The calls of a service since the start: open ones, ended ones by outcome, and how long these took, in seconds.

    `median` is interpolated in its bucket, and `worst` the bound that no call exceeded. Both are None without calls,
    or beyond the last bound.
    """

    name: str
    open: int
    outcomes: Mapping[str, int]
    median: float | None
    worst: float | None

    @property
    def text(self) -> str:
        """The numbers in words: `2 open, 14 answered, 1 timed_out, median 12 ms, at most 50 ms`."""
        parts = [f"{self.open} open"] if self.open else []
        parts += [f"{count} {outcome}" for outcome, count in self.outcomes.items()]
        if not self.outcomes:
            return ", ".join([*parts, "no call has ended"])
        median = "over 5 s" if self.median is None else f"{self.median * 1e3:.3g} ms"
        worst = "some over 5 s" if self.worst is None else f"at most {self.worst * 1e3:.0f} ms"
        return ", ".join([*parts, f"median {median}", worst])


def service_readings(now: Snapshot) -> Iterator[ServiceReading]:
    """Yield the services whose calls are counted, in the order of the table."""
    from router.observe.snapshot import BUCKETS, quantile

    for (name,), count in now.counts("service_calls_open").items():
        outcomes = {outcome: int(calls) for (outcome,), calls in now.of("service_calls", name).items() if calls}
        buckets = now.of(f"service_call_seconds{BUCKETS}", name)
        times = {float(bound): calls for (bound,), calls in buckets.items()}
        median, worst = quantile(times, 0.5), quantile(times, 1.0)
        yield ServiceReading(name, int(count), outcomes, _finite(median), _finite(worst))


def _finite(seconds: float | None) -> float | None:
    return seconds if seconds is not None and math.isfinite(seconds) else None
