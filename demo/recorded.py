"""What the router recorded of the lost link, read as anybody would read it."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from router.recording.reader import Recording
from router.table.model import RouteTable


@dataclass(frozen=True, slots=True)
class Recorded:
    """A recording that a deadman has had saved: where it is, and how many datagrams are in it."""

    path: Path
    datagrams: int


def recordings(table: RouteTable) -> frozenset[Path]:
    """Those that deadmen have had saved so far; none where the table keeps nothing."""
    return frozenset(table.record.directory.resolve().glob("*_deadman-*.mcap")) if table.record else frozenset()


def first_of(paths: Collection[Path]) -> Recorded | None:
    """The oldest, taken apart; None where there is none."""
    if not paths:
        return None
    path = min(paths)  # they are called after the time
    with closing(Recording(path)) as recording:
        return Recorded(path, sum(1 for _ in recording.datagrams()))
