"""A machine served as by a timekeeper that is always in time, or by one that is late; no clock, no thread."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from router.engine.machine import Machine

Event = tuple[int, Callable[[int], object]]
"""When something is called, and what; it is told the time."""


def serve(machine: Machine, until: int, late: int = 0) -> None:
    """Calls the machine whenever it is due, up to and with `until`, each time `late` ns after it is."""
    while machine.next_due is not None and machine.next_due + late <= until:
        due = machine.next_due
        machine.due(due + late)
        assert machine.next_due is None or machine.next_due > due


def play(machine: Machine, events: Iterable[Event], until: int, late: int = 0) -> None:
    for now, call in events:
        serve(machine, now, late)
        call(now)
    serve(machine, until, late)
