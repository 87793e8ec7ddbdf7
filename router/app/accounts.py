"""What has been counted since the router started, by all its threads, whatever tables it has had."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from router.compiler.metrics import Counters

Dropped = Callable[[], int]


class Accounts:
    """A list of counts for each thread, or lock, under which is counted; `counters` say where what is."""

    def __init__(self, counters: Counters) -> None:
        self.counters = counters
        self.drops = KernelDrops()
        self.threads = [counters.fresh_counts() for _ in range(8)]
        self.receive, self.ros, self.deadman, self.pacing, self.collecting = self.threads[:5]
        self.gateways, self.events, self.own = self.threads[5:]

    def total(self, metric: str) -> int:
        """What was counted under a counter's name, over all its labels."""
        slots = [index for series, index in self.counters.series() if series.metric == metric]
        return sum(counts[index] for counts in self.threads for index in slots)

    def make_room(self, counters: Counters) -> None:
        """For what counters that continue ours count, beside what ours do."""
        ours = dict(self.counters.series())
        new = [index for series, index in counters.series() if series not in ours]
        for counts in self.threads:
            counters.grow(counts)
            for index in new:  # where a program may have counted that was abandoned
                counts[index] = 0

    def settle(self, counters: Counters) -> None:
        """These are the counters now; nobody counts by the earlier ones any more."""
        counters.settle(self.threads)
        self.counters = counters  # from here on others read them: they do not change any more


class KernelDrops:
    """What the kernel dropped, by listener, and by gateway that receives datagrams; also before they were closed."""

    def __init__(self) -> None:
        self._now: dict[str, tuple[Dropped, int]] = {}
        self._before: dict[str, int] = {}

    def follow(self, name: str, dropped: Dropped, *, since: int = 0) -> None:
        """From now on `name` has what `dropped` tells of its socket beyond `since`."""
        self.leave(name)
        self._now[name] = dropped, since

    def leave(self, name: str) -> None:
        """Its socket is another's from now on, or nobody's."""
        if name in self._now:
            dropped, since = self._now.pop(name)
            self._before[name] = self._before.get(name, 0) + dropped() - since

    def totals(self) -> Iterator[tuple[str, int]]:
        for name in [*self._now, *(self._before.keys() - self._now.keys())]:
            dropped, since = self._now.get(name, (_none, 0))
            if (total := self._before.get(name, 0) + dropped() - since) or name in self._now:
                yield name, total


def _none() -> int:
    return 0
