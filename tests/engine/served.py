"""A timer served as by a timer thread that is always in time, or by one that is late; no clock, no thread."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from router.engine.timers import Timer

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
