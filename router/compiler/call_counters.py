"""The counters of the calls of a service, whoever pairs them with their responses."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from router.compiler.compiled_table import ANSWERED
from router.compiler.metrics import CALL_BOUNDS_NS, CALL_OUTCOMES, HISTOGRAM_CELLS, Counters


class Counts(Protocol):
    """The values of counters, by index."""

    def __getitem__(self, index: int, /) -> int: ...

    def __setitem__(self, index: int, value: int, /) -> None: ...


@dataclass(frozen=True, slots=True)
class CallCounters:
    """Indexes of the counters of a service: of its open calls, of the time that calls took, and of their outcomes."""

    open: int
    seconds: int
    outcomes: Mapping[str, int]

    @classmethod
    def of(cls, counters: Counters, service: str) -> CallCounters:
        """Return those of a service, by its name in metrics."""
        return cls(
            counters.index("service_calls_open", service),
            counters.index("service_call_seconds", service),
            {outcome: counters.index("service_calls", service, outcome) for outcome in CALL_OUTCOMES},
        )

    def count(self, counts: Counts, outcome: str, duration: int) -> None:
        """Count a call that has ended after `duration` ns: one of CALL_OUTCOMES."""
        counts[self.outcomes[outcome]] += 1
        counts[self.seconds + bisect_left(CALL_BOUNDS_NS, duration)] += 1
        counts[self.seconds + HISTOGRAM_CELLS - 1] += duration


def is_failure(outcome: str) -> bool:
    """Return whether a call that ended so is reported: not if it was answered, or nobody waits for it any more."""
    return outcome not in (ANSWERED, "cancelled")
