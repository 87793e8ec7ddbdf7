"""A router without threads: a real program, counters that a test writes, and datagrams from a test."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from functools import cache
from ipaddress import IPv4Network
from pathlib import Path
from typing import cast

from prometheus_client.metrics_core import Metric as Family

from router.clock import boottime_ns, wall_ns
from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable
from router.compiler.metrics import Mismatch
from router.datagrams import Peer
from router.errors import SourceSpan
from router.net.doors import Door
from router.observe.health import HealthSnapshot
from router.observe.http import HttpServer
from router.observe.metrics import CountersCollector
from router.observe.obedience import Reply
from router.observe.readings import Readings
from router.observe.running import ReloadResult
from router.observe.snapshot import SERIES, Snapshot
from router.observe.watch import Health, Watch
from router.recording.mirror import Acted, Classifier, Mirror, Mirrored
from router.table.addresses import Address
from tests.recording.recorder_rig import Listed
from tests.tables import ROUTES

SPAN = SourceSpan("routes/sim.yaml", 8, 20, 34)
LOOPBACK = Address("127.0.0.1", 0)
RELOADED = ReloadResult(True, (), "nothing has changed")


_LATER = [0] * 100
"""What a reading has of series that a test opens after it."""


@cache
def sim_program() -> CompiledTable:
    """The program of routes/sim.yaml."""
    program = check_table(ROUTES / "sim.yaml").program
    assert program is not None
    return program


class FakeRunning:
    """`failures` has exceptions of the mirror's consumers, `collected` counts reads of the counters.

    `began`: when it was started (boot clock, ns). `texts`: states that are texts, where they are not initial.
    """

    def __init__(self, program: CompiledTable) -> None:
        self.program = program
        self.is_ready = True
        self.is_stuck = False
        self.reloads = RELOADED
        self.failures: list[Exception] = []
        self.seen: dict[Mismatch, int] = {}
        self.given_replies: dict[tuple[str, str], Reply] = {}
        self.collected = 0
        self.mirror = Mirror(self, self.failures.append)
        self.lost = 0
        self.waiting: deque[Mirrored] = deque()
        self.acted: deque[Acted] = deque()
        self.counts = program.counters.fresh_counts()
        self.texts: dict[str, str] = {}
        self.began = boottime_ns()
        self._turns = 0

    def observe(self, *, is_observed: bool) -> None:
        pass

    def take(self) -> Listed:
        return Listed(self.waiting.popleft() for _ in range(len(self.waiting)))

    def take_actions(self) -> Listed:
        return Listed(self.acted.popleft() for _ in range(len(self.acted)))

    def count(self, metric: str, *labels: str, to: float) -> None:
        """Times are in ns, as in the counters."""
        index = self.program.counters.index(metric, *labels)
        self.program.counters.grow(self.counts)
        self.counts[index] = to  # type: ignore[call-overload]  # the value may be no integer

    def receive(self, data: bytes, peer: Peer, listener: str = "rover", reason: str = "") -> None:
        """`reason`: why no route takes it."""
        known = Classifier(self.program.envelopes, self.program.table)
        if self.mirror.is_observed:
            self.waiting.append((wall_ns(), listener, peer, known.sender(listener, peer), reason, data))

    def collect(self) -> Iterator[Family]:
        self.collected += 1
        return CountersCollector(self._readings(), {"version": "1"}, self.clock_ns).collect()

    def read(self, now: int, metrics: Collection[str] = SERIES) -> Snapshot:
        self.collected += 1
        return Snapshot(now / 1e9, self._readings().read(self.clock_ns(), metrics))

    def _readings(self) -> Readings:
        computed = {
            metric: lambda: ()
            for metric in ("gateway_client_lag_seconds", "gateway_client_sent", "gateway_client_dropped")
        } | {"endpoint_stale_after_seconds": self._stale_after, "state_text": self._state_texts}
        counters, known = self.program.counters, dict.fromkeys(self.program.table.endpoints, self.began)
        return Readings(counters, lambda: [*self.counts, *_LATER], computed, known)

    def clock_ns(self) -> int:
        return boottime_ns()

    def _stale_after(self) -> Iterator[tuple[tuple[str, str], float]]:
        for endpoint in self.program.table.endpoints.values():
            if endpoint.stale_after is not None:
                yield (endpoint.name, endpoint.kind.value), endpoint.stale_after / 1e9

    def _state_texts(self) -> Iterator[tuple[tuple[str, str], float]]:
        for state in self.program.states:
            if state.is_text:
                yield (state.name, self.texts.get(state.name, str(state.initial))), 1

    def replies(self) -> dict[tuple[str, str], Reply]:
        return self.given_replies

    def mismatches(self) -> dict[Mismatch, int]:
        return self.seen

    def progress(self) -> int:
        self._turns += not self.is_stuck
        return self._turns

    def reload(self) -> ReloadResult:
        return self.reloads


class FakeHealth:
    """Evaluated on request. Counts since `begin` are recent.

    `parked` is how long deadmen have been sending, in s.
    """

    def __init__(self, running: FakeRunning) -> None:
        self._running = running
        self.parked = 0.0
        self.begin()

    def begin(self) -> None:
        self._watch = Watch(self._running)
        self._first = self._look()

    @property
    def is_stuck(self) -> bool:
        return self._running.is_stuck

    def look(self) -> HealthSnapshot:
        health = self._look()
        snapshots = (self._first.now, health.now)
        tripped = dict.fromkeys(health.tripped, self.parked)
        stalled_for = 3.0 if self.is_stuck else 0.0
        return replace(health, snapshots=snapshots, stalled_for=stalled_for, tripped=tripped)

    def _look(self) -> HealthSnapshot:
        collected = self._running.collected
        health = self._watch.look(boottime_ns())
        self._running.collected = collected
        return health


def served(
    running: FakeRunning,
    save: Callable[[str], Path] | None = None,
    address: Address = LOOPBACK,
    health: FakeHealth | None = None,
    networks: Sequence[IPv4Network] = (),
) -> HttpServer:
    door = Door("http", networks, Counter())
    return HttpServer(address, SPAN, door, running, cast("Health", health or FakeHealth(running)), save)
