"""The counts of all threads, kept across reloads."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from functools import partial
from typing import cast

from router.app.change import Change
from router.carrier.forwarding import fresh_counts
from router.carrier.threads import NativeThread
from router.compiler.metrics import Counters
from router.library import library


class ThreadCounts:
    """All counts since the start, kept across reloads: an array of counts for each thread or lock.

    `counters` belongs to the running program and assigns the indexes.
    """

    def __init__(self, counters: Counters) -> None:
        self.counters = counters
        self.lists: list[list[int]] = []
        self._copies: list[Callable[[int], ctypes.Array[ctypes.c_int64]]] = []
        for _ in range(3):
            counts = fresh_counts()
            self._add(counts, partial(_copied, counts))
        self.gateways, self.events, self.own = self.lists

    def add_thread(self, thread: NativeThread) -> None:
        """Include the counts of a native thread, in consistent copies."""
        self._add(thread.counts, thread.counters)

    def _add(self, counts: ctypes.Array[ctypes.c_int64], copy: Callable[[int], ctypes.Array[ctypes.c_int64]]) -> None:
        self.lists.append(cast("list[int]", counts))  # it is only indexed and sliced
        self._copies.append(copy)

    def totals(self, latest: bytes) -> Sequence[int]:
        """Return the counts of all threads together, as many as `latest` (see Counters.latest) has bytes.

        Those of a native thread are a snapshot between two messages.
        """
        size = len(latest)
        totals, join = (ctypes.c_int64 * size)(), library().counters_join
        for copy in self._copies:
            join(totals, copy(size), latest, size)
        return cast("Sequence[int]", totals)

    def total(self, metric: str) -> int:
        """Return the sum of a counter over all its labels."""
        indexes = [index for _, index in self.counters.series_of(metric)]
        return sum(counts[index] for counts in self.lists for index in indexes)

    # adoption of another program

    def prepare(self, change: Change) -> None:
        """Make room for its counts."""
        counters = change.program.counters
        new = list(counters.new_runs(self.counters))
        for counts in self.lists:
            for run in new:  # a program that was abandoned may have counted there
                counts[run] = [0] * (run.stop - run.start)

    def adopt(self, change: Change) -> None:
        """Adopt its counters. The indexes of earlier ones stay reserved, because threads may still use them."""
        self.counters = change.program.counters  # from now on, other threads read them

    def finish(self, change: Change) -> None:
        """Free the indexes of series that only earlier programs had."""
        if change.program.counters is self.counters:
            self.counters.settle(self.lists)


def _copied(counts: ctypes.Array[ctypes.c_int64], size: int) -> ctypes.Array[ctypes.c_int64]:
    return (ctypes.c_int64 * size).from_buffer_copy(counts)
