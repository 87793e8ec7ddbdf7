"""The counts of all threads, kept across reloads."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

from router.app.change import Change
from router.carrier.forwarding import MOST_COUNTERS
from router.carrier.threads import NativeThread
from router.compiler.metrics import Counters
from router.errors import ConfigurationError


class ThreadCounts:
    """All counts since the start, kept across reloads: a list of counts for each thread or lock.

    `counters` belongs to the running program and assigns the indexes.
    """

    def __init__(self, counters: Counters) -> None:
        self.counters = counters
        self.lists: list[list[int]] = []
        self._copies: list[Callable[[int], list[int]]] = []
        for _ in range(3):
            self._add(counters.fresh_counts(), None)
        self.gateways, self.events, self.own = self.lists

    def add_thread(self, thread: NativeThread) -> None:
        """Include the counts of a native thread, in consistent copies."""
        self._add(cast("list[int]", thread.counts), thread.counters)  # the array is only indexed and sliced

    def _add(self, counts: list[int], copy: Callable[[int], list[int]] | None) -> None:
        self.counters.grow(counts)
        self.lists.append(counts)
        self._copies.append(copy or (lambda size: counts[:size]))

    def copies(self, size: int) -> list[list[int]]:
        """Return the first `size` counts of each list, as a snapshot if the thread provides one."""
        return [copy(size) for copy in self._copies]

    def total(self, metric: str) -> int:
        """Return the sum of a counter over all its labels."""
        indexes = [index for series, index in self.counters.series() if series.metric == metric]
        return sum(counts[index] for counts in self.lists for index in indexes)

    # adoption of another program

    def prepare(self, change: Change) -> None:
        """Make room for its counts. Raises ConfigurationError."""
        counters = change.program.counters
        if counters.size > MOST_COUNTERS:
            raise ConfigurationError(
                f"the table has {counters.size} counters, but there is room for only {MOST_COUNTERS}"
            )
        new = list(counters.new_runs(self.counters))
        for counts in self.lists:
            counters.grow(counts)
            for run in new:  # a program that was abandoned may have counted there
                counts[run] = [0] * (run.stop - run.start)

    def adopt(self, change: Change) -> None:
        """Adopt its counters. The indexes of earlier ones stay reserved, because threads may still use them."""
        self.counters = change.program.counters  # from now on, other threads read them

    def finish(self, change: Change) -> None:
        """Free the indexes of series that only earlier programs had."""
        if change.program.counters is self.counters:
            self.counters.settle(self.lists)
