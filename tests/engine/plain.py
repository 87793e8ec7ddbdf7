"""EngineContext without threads: for an engine whose machines nobody serves."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from router.compiler.metrics import Counters
from router.engine import Report
from router.engine.binding import EngineContext, TimerGroup


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
