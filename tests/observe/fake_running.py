"""A router that runs nothing: a real program, counters that a test writes, and datagrams that it has seen come."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from functools import cache

from prometheus_client.metrics_core import Metric as Family

from router.clock import wall_ns
from router.compiler import check_table
from router.compiler.program import Program
from router.datagrams import Peer
from router.observe.metrics import CountersCollector
from router.observe.running import ReloadResult
from router.recording.mirror import Classifier, Mirror, Mirrored
from tests.tables import ROUTES

RELOADED = ReloadResult(True, (), "nothing has changed")


@cache
def sim_program() -> Program:
    """Of routes/sim.yaml."""
    program = check_table(ROUTES / "sim.yaml").program
    assert program is not None
    return program


class FakeRunning:
    """`failures` is what consumers of the mirror raised, `collected` how often the counters were read."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self.is_ready = True
        self.is_stuck = False
        self.reloads = RELOADED
        self.failures: list[Exception] = []
        self.collected = 0
        self.mirror = Mirror(lambda: None, self.failures.append)
        self.lost = 0
        self.waiting: deque[Mirrored] = deque()
        self.mirror.show(lambda: [self.waiting.popleft() for _ in range(len(self.waiting))], lambda: self.lost)
        self.counts = program.counters.fresh_counts()
        self._turns = 0

    def count(self, metric: str, *labels: str, to: int) -> None:
        """Times are in ns, as in the counters."""
        self.counts[self.program.counters.index(metric, *labels)] = to

    def receive(self, data: bytes, peer: Peer, listener: str = "rover", reason: str = "") -> None:
        """`reason`: why no route takes it."""
        known = Classifier(self.program.envelope, self.program.table)
        if self.mirror.is_observed:
            self.waiting.append((wall_ns(), listener, peer, known.sender(listener, peer), reason, data))

    def collect(self) -> Iterator[Family]:
        self.collected += 1
        asked = {
            metric: lambda: ()
            for metric in ("gateway_client_lag_seconds", "gateway_client_sent", "gateway_client_dropped")
        }
        return CountersCollector(self.program.counters, lambda: [self.counts], asked, {"version": "1"}).collect()

    def progress(self) -> int:
        self._turns += not self.is_stuck
        return self._turns

    def reload(self) -> ReloadResult:
        return self.reloads
