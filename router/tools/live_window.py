"""The looks at a running router between whose first and last rates are told. Knows no HTTP, and no row."""

from __future__ import annotations

from collections import deque

from router.tools.live import Snapshot

WINDOW = 3.0
"""Seconds over which rates are told: over less, one message in two seconds is no rate but a flicker."""


class Window:
    """Snapshots of the last seconds, of one run of the router."""

    def __init__(self, seconds: float = WINDOW) -> None:
        self._seconds = seconds
        self._snapshots: deque[Snapshot] = deque()

    def add(self, newest: Snapshot) -> None:
        if self._snapshots and _is_of_another_run(self._snapshots[-1], newest):
            self._snapshots.clear()
        while len(self._snapshots) > 1 and newest.at - self._snapshots[1].at >= self._seconds:
            self._snapshots.popleft()
        self._snapshots.append(newest)

    def clear(self) -> None:
        self._snapshots.clear()

    @property
    def ends(self) -> tuple[Snapshot, Snapshot]:
        """The first and the last of them, which may be the same one. There is one at least."""
        return self._snapshots[0], self._snapshots[-1]


def _is_of_another_run(before: Snapshot, after: Snapshot) -> bool:
    """What was counted once stays counted until the router starts anew."""
    return any(
        after.counts(metric).get(labels, 0.0) < count
        for metric in ("datagrams_received", "messages_received")
        for labels, count in before.counts(metric).items()
    )
