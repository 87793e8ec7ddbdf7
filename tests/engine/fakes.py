"""Fakes around the engine: a context without threads, targets with their own counters, served timers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from router.compiler.metrics import DROP_REASONS, Counters
from router.compiler.program import TargetPlan
from router.engine.binding import EngineContext, TimerGroup
from router.engine.delivery import FrameOutcome, Outcome, Report
from router.engine.timers import Timer


def plain_outlets(
    counters: Counters,
    send: Mapping[str, Callable[[bytes], int]],
    publish: Mapping[str, Callable[[bytes], None]],
    report: Callable[[Report], None],
    wall_ns: int = 0,
    counts: list[int] | None = None,
    publish_errors: tuple[type[Exception], ...] = (),
) -> EngineContext:
    """Everybody listens on every topic, the clocks stand still, and no deadman ever trips."""
    counts = counters.fresh_counts() if counts is None else counts
    ungrouped = TimerGroup(counts, lambda _, call: call)
    return EngineContext(
        counts=counts,
        send=send,
        publish=publish,
        wanted={topic: [True] for topic in publish},
        report=report,
        clock_ns=lambda: 0,
        wall_ns=lambda: wall_ns,
        pacing=ungrouped,
        collecting=ungrouped,
        feed=lambda *_: lambda _: None,
        publish_errors=publish_errors,
    )


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


Event = tuple[int, Callable[[int], object]]
"""When something is called, and what; it is told the time."""


def serve(timer: Timer, until: int, late: int = 0) -> None:
    """Calls the timer whenever it is due, up to and with `until`, each time `late` ns after it is."""
    while timer.next_due is not None and timer.next_due + late <= until:
        due = timer.next_due
        timer.due(due + late)
        assert timer.next_due is None or timer.next_due > due


def play(timer: Timer, events: Iterable[Event], until: int, late: int = 0) -> None:
    for now, call in events:
        serve(timer, now, late)
        call(now)
    serve(timer, until, late)
