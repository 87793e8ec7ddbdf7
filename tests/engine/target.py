"""A target of a route with counters of its own, for machines that count without an engine around them."""

from __future__ import annotations

from collections.abc import Mapping

from router.compiler.metrics import DROP_REASONS, Counters
from router.compiler.program import TargetPlan
from router.engine.delivery import FrameOutcome, Outcome, Report


class _Target:
    route = "a_route"

    def __init__(self, name: str, is_topic: bool, metrics: tuple[str, ...]) -> None:
        self.name = name
        self.reports: list[Report] = []
        self._counters = Counters()
        for metric in metrics:
            self._counters.index(metric, self.route, name)
        for reason in DROP_REASONS:
            self._counters.index("messages_dropped", self.route, name, reason)
        self._counts = self._counters.fresh_counts()
        self._plan = TargetPlan(name, name, is_topic, None)

    def counted(self) -> Mapping[str, int]:
        """What is not zero, by metric, of what was dropped by reason."""
        counted = {series: self._counts[index] for series, index in self._counters.series() if self._counts[index]}
        return {series.labels[2] if len(series.labels) > 2 else series.metric: n for series, n in counted.items()}


class Destination(_Target):
    def __init__(self, name: str = "a_board") -> None:
        super().__init__(name, False, ("datagrams_sent", "sent_bytes", "messages_filtered"))
        self.outcome = Outcome(self._counters, self._counts, self.route, self._plan, self.reports.append)


class Topic(_Target):
    """Of a route that collects."""

    def __init__(self, name: str = "a_topic") -> None:
        super().__init__(name, True, ("messages_published", "messages_filtered", "messages_collected"))
        self.outcome = FrameOutcome(self._counters, self._counts, self.route, self._plan, self.reports.append)
