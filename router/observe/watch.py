"""Takes a snapshot of a running router once a second, to find losses of the last seconds."""

from __future__ import annotations

import threading
from collections import deque

from router.clock import boottime_ns
from router.log import logger
from router.observe.bursts import Bursts
from router.observe.health import PERIOD, WINDOW, HealthSnapshot
from router.observe.problems import Kind
from router.observe.running import Running
from router.observe.snapshot import DELIVERED, Snapshot
from router.threads import Thread, background_threads, join_or_abandon

METRICS = {kind.metric for kind in Kind} | {
    "datagrams_received",
    "deadman_datagrams_sent",
    "deadman_trips",
    "endpoint_last_silence_seconds",
    "endpoint_learned",
    "endpoint_stale_after_seconds",
    "gateway_clients",
    "messages_filtered",
    "messages_received",
    "mirror_dropped",
    "recordings_lost",
    "state",
    "state_changes",
    "state_set_seconds",
    "state_text",
    "topic_subscribers",
    *DELIVERED,
}
"""The metrics read each second. Histograms, which have most of the series, are not among them."""


class Watch:
    """Keeps the last snapshots and bursts, and since when deadmen send and the receive thread is stuck.

    Thread-safe.
    """

    def __init__(self, running: Running) -> None:
        self._running = running
        self._snapshots: deque[Snapshot] = deque()
        self._tripped: dict[str, tuple[float, int]] = {}  # by route: number of trips, and when it was first seen
        self._silences: dict[str, tuple[float, int]] = {}  # by endpoint: number of silences, likewise
        self._bursts = Bursts()
        self._progress, self._progressed = -1, 0
        self._lock = threading.Lock()

    def look(self, now: int) -> HealthSnapshot:
        """Return the state at `now` (boot clock, ns). One snapshot per PERIOD is kept for later calls."""
        with self._lock:
            program, latest = self._running.program, self._running.read(now, METRICS)
            self._tripped = {
                route: found if (found := self._tripped.get(route, (-1, 0)))[0] == trips else (trips, now)
                for (route,), trips in latest.counts("deadman_trips").items()
                if latest.of(Kind.DEADMAN_ACTIVE.metric, route).get(())
            }
            self._silences = {
                endpoint: found if (found := self._silences.get(endpoint, (-1, 0)))[0] == silences else (silences, now)
                for (endpoint,), silences in latest.counts("endpoint_silences").items()
                if silences
            }
            returned = {name: (now - since) / 1e9 for name, (_, since) in self._silences.items()}
            tripped = {route: (now - since) / 1e9 for route, (_, since) in self._tripped.items()}
            while self._snapshots and latest.at - self._snapshots[0].at > WINDOW + PERIOD / 2:
                self._snapshots.popleft()
            snapshots = (*self._snapshots, latest)
            if len(snapshots) == 1:
                self._snapshots.append(latest)
            elif latest.at - snapshots[-2].at > 0.9 * PERIOD:
                driven = [route.name for route in program.table.routes if route.deadman and route.sources]
                self._bursts.note(snapshots[-2], latest, driven)
                self._snapshots.append(latest)
            bursts = self._bursts.recent(latest.at, WINDOW)
        recent = frozenset(each for each, at in self._running.mismatches().items() if now - at < WINDOW * 1e9)
        replies = self._running.replies()
        return HealthSnapshot(program, snapshots, self.stalled_for(now), tripped, recent, replies, bursts, returned)

    def stalled_for(self, now: int) -> float:
        """Return how long (s) the receive thread has made no progress, as seen by calls of this method."""
        progress = self._running.progress()
        with self._lock:
            if progress != self._progress:
                self._progress, self._progressed = progress, now
            return (now - self._progressed) / 1e9


class Health:
    """Looks at the router once per PERIOD in a thread, until it is closed. Thread-safe."""

    def __init__(self, running: Running) -> None:
        self._watch = Watch(running)
        self._stopping = threading.Event()
        self._thread = Thread(self._run, "health")
        with background_threads():
            self._thread.start()

    @property
    def is_stuck(self) -> bool:
        """Whether the receive thread is stuck now."""
        return self._watch.stalled_for(boottime_ns()) > Kind.RECEIVE_STUCK.threshold

    def close(self) -> None:
        self._stopping.set()
        join_or_abandon(self._thread)

    def look(self) -> HealthSnapshot:
        return self._watch.look(boottime_ns())

    def _run(self) -> None:
        has_failed = False
        while not self._stopping.wait(PERIOD):
            try:
                self.look()
            except Exception as error:  # noqa: BLE001 routing continues without health
                if not has_failed:
                    logger.error("cannot determine the router's health", problem=repr(error))
                has_failed = True
            else:
                has_failed = False
