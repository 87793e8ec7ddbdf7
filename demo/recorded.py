"""Reads the router's recording of the lost link."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from router.recording.reader import Recording
from router.table.model import RouteTable


@dataclass(frozen=True, slots=True)
class Recorded:
    """A recording that was saved because a deadman tripped, and its number of datagrams."""

    path: Path
    datagrams: int


def recordings(table: RouteTable) -> frozenset[Path]:
    """Recordings saved so far because a deadman tripped; empty if the table records nothing."""
    return frozenset(table.record.directory.resolve().glob("*_deadman-*.mcap")) if table.record else frozenset()


def first_of(paths: Collection[Path]) -> Recorded | None:
    """Read the oldest recording; None if there is none."""
    if not paths:
        return None
    path = min(paths)  # names contain the time
    with closing(Recording(path)) as recording:
        return Recorded(path, sum(1 for _ in recording.datagrams()))
