"""Reads the counters by name, and says where they do not balance."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from router.compiler.metrics import HISTOGRAM_CELLS
from router.compiler.program import Handler, Program


class Ledger:
    """The counters of a program with their counts at the time of each call; timestamps and histograms left out."""

    def __init__(self, program: Program, counts: Sequence[int]) -> None:
        self._program = program
        self._counts = counts

    def counted(self, *prefixes: str) -> Mapping[tuple[str, ...], int]:
        """What is not zero, by metric and labels, of the metrics whose name starts like one of these."""
        return {
            (series.metric, *series.labels): self._counts[index]
            for series, index in self._program.counters.series()
            if self._counts[index] and series.metric.startswith(prefixes) and not series.metric.endswith("seconds")
        }

    def total(self, metric: str, *labels: str) -> int:
        """The sum over all series of a metric whose labels begin like this."""
        return sum(count for key, count in self.counted(metric).items() if key[: 1 + len(labels)] == (metric, *labels))

    def imbalances(self) -> Iterator[str]:
        """Expects that nothing waits: no frame is open, and nothing is held back for later."""
        inbound = [handler for handlers in self._program.inbound.values() for handler in handlers]
        outbound = [handler for handlers in self._program.outbound.values() for handler in handlers]
        received, rejected = self.total("datagrams_received"), self.total("datagrams_rejected")
        accepted = sum(self.total("messages_received", handler.route) for handler in inbound)
        if received != accepted + rejected:
            yield f"received {received}, but accepted {accepted} and rejected {rejected}"
        for handler in inbound:
            yield from self._time_of_route(handler.route)
        for handler in (*inbound, *outbound):
            yield from self._fates(handler)

    def _time_of_route(self, route: str) -> Iterator[str]:
        accepted = self.total("messages_received", route)
        first = self._program.counters.index("route_duration_seconds", route)
        if accepted != (timed := sum(self._counts[first : first + HISTOGRAM_CELLS - 1])):
            yield f"{route}: accepted {accepted}, but the histogram holds {timed}"

    def _fates(self, handler: Handler) -> Iterator[str]:
        route, accepted = handler.route, self.total("messages_received", handler.route)
        for target in handler.targets:
            delivered = "messages_published" if target.is_topic else "datagrams_sent"
            metrics = (delivered, "messages_dropped", "messages_filtered", "messages_collected")
            fates = [self.total(metric, route, target.label) for metric in metrics]
            if accepted != sum(fates):
                kinds = "delivered, dropped, filtered, collected"
                yield f"{route} to {target.label}: accepted {accepted}, but {kinds} {fates}"
