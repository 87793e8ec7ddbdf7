"""An engine between fakes: outlets that record and fail on demand, clocks that are set; its counters, read by name.

Parts of an engine between fakes: targets with counters of their own, and timers that are served when they are due.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import ParamSpec, TypeVar

from router.compiler import check_table
from router.compiler.lookup import Definitions
from router.compiler.metrics import DROP_REASONS, HISTOGRAM_CELLS, Counters, Report
from router.compiler.program import Handler, Program, TargetPlan
from tests.oracles.python_engine import InboundEngine, OutboundEngine
from tests.oracles.python_engine.binding import EngineContext, TimerGroup
from tests.oracles.python_engine.deadman import Deadman, commander
from tests.oracles.python_engine.delivery import FrameOutcome, Outcome
from tests.oracles.python_engine.freshness import Freshness
from tests.oracles.python_engine.handlers import remember
from tests.oracles.python_engine.pacing import Pacer
from tests.oracles.python_engine.timers import Timer
from tests.tables import PROTOS

HEAD = """version: 1
envelope: {protos: PROTOS, message: PBEnvelope, oneof: payload}
listen:
  trimmed: {address: 127.0.0.1:5000, framing: zero_trimmed}
  exact: {address: 127.0.0.1:5001, framing: exact}
endpoints:
  sensor_board: {address: 192.168.0.30:8, kind: board}
  driving_board: {address: 192.168.0.222:8, kind: board}
  basestation: {address: 192.168.0.10:9000, kind: basestation}
  recorder: {address: 192.168.0.20:9000, kind: tool, trim_trailing_zeros: true}
  left_tool: {address: 192.168.0.60:7001, kind: tool, source_port: 8001}
  right_tool: {address: 192.168.0.60:7002, kind: tool, source_port: 8002}
routes:
"""
"""Every table of these tests begins like this; what follows are its routes, indented by two."""

HEAD_OF_LISTENERS = (
    HEAD.replace("kind: basestation}", "kind: basestation, listener: exact}")
    .replace("source_port: 8001}", "source_port: 8001, listener: trimmed}")
    .replace("source_port: 8002}", "source_port: 8002, listener: exact}")
    .replace("  recorder:", "  impostor: {address: 192.168.0.10:9001, kind: tool, listener: trimmed}\n  recorder:")
)
"""With endpoints that are believed by one listener; `impostor` has the basestation's address on the other one."""

SENSOR_BOARD = ("192.168.0.30", 8)
DRIVING_BOARD = ("192.168.0.222", 8)
BASESTATION = ("192.168.0.10", 9000)
LEFT_TOOL = ("192.168.0.60", 8001)
RIGHT_TOOL = ("192.168.0.60", 8002)
STRANGER = ("192.168.0.99", 1234)

Outlet = Callable[[bytes], None]
P = ParamSpec("P")
R = TypeVar("R")


@cache
def _definitions() -> Definitions:
    return Definitions()


def program(folder: Path, routes: str, head: str = HEAD, protos: Path | None = None) -> Program:
    """The compiled table. What is wrong with it fails the test; a case that is not covered is fine."""
    path = folder / "table.yaml"
    path.write_text(head.replace("PROTOS", str(protos or PROTOS)) + routes)
    checked = check_table(path, {}, _definitions())
    assert checked.program is not None, "\n".join(map(str, checked.diagnostics))
    remember(checked)
    return checked.program


class Ledger:
    """The counters of a program with their counts at the time of each call; timestamps and histograms left out."""

    def __init__(self, program: Program, counts: Sequence[int]) -> None:
        self._program = program
        self._counts = counts

    def counted(self, *prefixes: str) -> Mapping[tuple[str, ...], int]:
        """What is not zero, by metric and labels, of the metrics whose name starts like one of these."""
        return {
            (series.metric, *series.labels): self._counts[index]
            for series, index in self._program.counters.series()
            if self._counts[index] and series.metric.startswith(prefixes) and not series.metric.endswith("seconds")
        }

    def total(self, metric: str, *labels: str) -> int:
        """The sum over all series of a metric whose labels begin like this."""
        return sum(count for key, count in self.counted(metric).items() if key[: 1 + len(labels)] == (metric, *labels))

    def imbalances(self) -> Iterator[str]:
        """Expects that no frame is open, and nothing is held back for later."""
        inbound = [handler for handlers in self._program.inbound.values() for handler in handlers]
        outbound = [handler for handlers in self._program.outbound.values() for handler in handlers]
        received, rejected = self.total("datagrams_received"), self.total("datagrams_rejected")
        accepted = sum(self.total("messages_received", handler.route) for handler in inbound)
        if received != accepted + rejected:
            yield f"received {received}, but accepted {accepted} and rejected {rejected}"
        for handler in inbound:
            yield from self._time_of_route(handler.route)
        for handler in (*inbound, *outbound):
            yield from self._fates(handler)

    def _time_of_route(self, route: str) -> Iterator[str]:
        accepted = self.total("messages_received", route)
        first = self._program.counters.index("route_duration_seconds", route)
        if accepted != (timed := sum(self._counts[first : first + HISTOGRAM_CELLS - 1])):
            yield f"{route}: accepted {accepted}, but the histogram holds {timed}"

    def _fates(self, handler: Handler) -> Iterator[str]:
        route, accepted = handler.route, self.total("messages_received", handler.route)
        for target in handler.targets:
            delivered = "messages_published" if target.is_topic else "datagrams_sent"
            metrics = (delivered, "messages_dropped", "messages_filtered", "messages_collected", "messages_waiting")
            fates = [self.total(metric, route, target.label) for metric in metrics]
            if accepted != sum(fates):
                kinds = "delivered, dropped, filtered, collected, waiting"
                yield f"{route} to {target.label}: accepted {accepted}, but {kinds} {fates}"


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


class _Target:
    route = "a_route"

    def __init__(self, name: str, is_topic: bool, metrics: tuple[str, ...]) -> None:
        self.name = name
        self.reports: list[Report] = []
        self._counters = Counters()
        for metric in metrics:
            self._counters.index(metric, self.route, name)
        for reason in DROP_REASONS:
            self._counters.index("messages_dropped", self.route, name, reason)
        self._counts = self._counters.fresh_counts()
        self._plan = TargetPlan(name, is_topic, None)

    def counted(self) -> Mapping[str, int]:
        """What is not zero, by metric, of what was dropped by reason."""
        counted = {series: self._counts[index] for series, index in self._counters.series() if self._counts[index]}
        return {series.labels[2] if len(series.labels) > 2 else series.metric: n for series, n in counted.items()}


class Destination(_Target):
    def __init__(self, name: str = "a_board") -> None:
        super().__init__(name, False, ("datagrams_sent", "sent_bytes", "messages_filtered"))
        self.outcome = Outcome(self._counters, self._counts, self.route, self._plan, self.reports.append)


class Topic(_Target):
    """Of a route that collects."""

    def __init__(self, name: str = "a_topic") -> None:
        super().__init__(name, True, ("messages_published", "messages_filtered", "messages_collected"))
        self.outcome = FrameOutcome(self._counters, self._counts, self.route, self._plan, self.reports.append)


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
