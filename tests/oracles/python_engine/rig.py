"""An engine between fakes: outlets that record and fail on demand, clocks that are set; its counters, read by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import ParamSpec, TypeVar

from router.compiler.metrics import Report
from router.compiler.program import Program
from tests.oracles.python_engine import InboundEngine, OutboundEngine
from tests.oracles.python_engine.binding import EngineContext, TimerGroup
from tests.oracles.python_engine.deadman import Deadman, commander
from tests.oracles.python_engine.freshness import Freshness
from tests.oracles.python_engine.pacing import Pacer
from tests.oracles.python_engine.timers import Timer
from tests.small_tables import SENSOR_BOARD, Ledger

Outlet = Callable[[bytes], None]
P = ParamSpec("P")
R = TypeVar("R")


class Rig:
    """An engine and everything that came out of it.

    `failures` makes an outlet raise, by endpoint or topic. `now` is the boot clock in ns, the wall
    clock is `WALL` ahead of it until it is set; every call of an outlet takes `work_ns`. `unwanted` topics have no
    subscriber. `changes` has what deadmen said. One thread does everything here, so one list has all counts.
    """

    WALL = 1_700_000_000_000_000_000

    def __init__(self, made: Program, unwanted: frozenset[str] = frozenset()) -> None:
        self.program = made
        self.counts = made.counters.fresh_counts()
        self.ledger = Ledger(made, self.counts)
        self.now = 0
        self.work_ns = 0
        self._settings = [(0, self.WALL)]  # since when the wall clock is by how much ahead
        self.sent: list[tuple[str, bytes]] = []
        self.published: list[tuple[str, bytes]] = []
        self.reports: list[Report] = []
        self.failures: dict[str, Exception] = {}
        self.wanted = {plan.label: [plan.label not in unwanted] for plan in made.publishers}
        self.timers: list[Timer] = []
        group = TimerGroup(self.counts, self._locked)
        send = {plan.name: self._sender(plan.name) for plan in made.senders}
        pacers = {plan.name: Pacer(plan.bandwidth) for plan in made.senders if plan.bandwidth}
        deadmen = {
            plan.route: Deadman(plan, made.counters, self.counts, send, self.reports.append, self._changed)
            for plan in made.deadmen
        }
        self.timers += pacers.values()
        self.context = EngineContext(
            counts=self.counts,
            send=send,
            publish={plan.label: self._outlet(plan.label, self.published) for plan in made.publishers},
            wanted=self.wanted,
            report=self.reports.append,
            clock_ns=lambda: self.now,
            wall_ns=lambda: self.wall(self.now),
            pacing=group,
            holding=group,
            collecting=group,
            command=commander(send, deadmen, self._locked, lambda: self.now),
            publish_errors=(PublishError,),
            pacers=pacers,
            boards=made.boards,
        )
        self.arrived_before = 0
        arrived_at = {plan.name: lambda: self.wall(self.now - self.arrived_before) for plan in made.listeners}
        engine = InboundEngine(made, self.context, arrived_at, Freshness())
        self.receivers = {plan.name: engine.receiver(plan.name) for plan in made.listeners}
        outbound = OutboundEngine(made, self.context, Freshness())
        self.takers = {plan.label: outbound.taker(plan.label) for plan in made.subscriptions}
        self.changes: list[tuple[str, bool]] = []

    def receive(self, data: bytes, peer: tuple[str, int] = SENSOR_BOARD, listener: str = "trimmed") -> None:
        self.receivers[listener](data, peer)

    def take(self, topic: str, cdr: bytes, *, follows: bool = False) -> None:
        """A ROS message, which set out `arrived_before` ns ago, perhaps after the last one."""
        self.takers[topic](cdr, self.wall(self.now - self.arrived_before), follows)

    def wall(self, time: int) -> int:
        """What the wall clock showed at `time`."""
        return time + next(ahead for since, ahead in reversed(self._settings) if since <= time or not since)

    def set_clock(self, by: int) -> None:
        """Sets the wall clock forward, or back."""
        self._settings.append((self.now, self._settings[-1][1] + by))

    def pass_time(self, ns: int) -> None:
        """Moves the clocks, and serves timers when they are due."""
        until = self.now + ns
        while (next_due := self._next_due()) is not None and next_due <= until:
            self.now = max(self.now, next_due)
            for timer in self.timers:
                if timer.next_due is not None and timer.next_due <= self.now:
                    timer.due(self.now)
        self.now = until

    def _next_due(self) -> int | None:
        return min((timer.next_due for timer in self.timers if timer.next_due is not None), default=None)

    def _locked(self, timer: Timer, call: Callable[P, R]) -> Callable[P, R]:
        if timer not in self.timers:
            self.timers.append(timer)
        return call

    def _changed(self, route: str, active: bool) -> None:
        self.changes.append((route, active))

    def count(self, metric: str, *labels: str, part: int = 0) -> int:
        return self.counts[self.program.counters.index(metric, *labels) + part]

    def counted(self, *prefixes: str) -> Mapping[tuple[str, ...], int]:
        return self.ledger.counted(*prefixes)

    def rejected(self, listener: str = "trimmed") -> str | None:
        """The one reason for which this listener rejected anything."""
        found = [labels[2] for labels in self.counted("datagrams_rejected") if labels[1] == listener]
        assert len(found) <= 1
        return found[0] if found else None

    def dropped(self, route: str, target: str) -> Mapping[str, int]:
        found = self.counted("messages_dropped").items()
        return {labels[3]: count for labels, count in found if labels[1:3] == (route, target)}

    def assert_counters_balance(self) -> None:
        assert list(self.ledger.imbalances()) == []

    def _sender(self, endpoint: str) -> Callable[[bytes], int]:
        take = self._outlet(endpoint, self.sent)

        def send(datagram: bytes) -> int:
            take(datagram)
            return len(datagram)

        return send

    def _outlet(self, name: str, taken: list[tuple[str, bytes]]) -> Outlet:
        def take(data: bytes) -> None:
            self.now += self.work_ns
            if name in self.failures:
                raise self.failures[name]
            taken.append((name, data))

        return take


class PublishError(Exception):
    """What the middleware raises here."""
