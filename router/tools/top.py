"""What `router top` shows: rates, drops, ages and latencies between two snapshots of a router's metrics."""

from __future__ import annotations

import enum
import math
from collections import defaultdict, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from router.compiler.metrics import INTENDED_REASONS
from router.observe.problems import DROPS, Kind, Level, Problem
from router.observe.services import ServiceReading, service_readings
from router.observe.snapshot import BUCKETS, DELIVERED, Counts, Snapshot, quantile
from router.observe.states import StateReading

WINDOW = 4.0
"""Seconds over which rates and latencies are computed, as on the status page.

With less, the rate of one message in two seconds flickers.
"""


class Order(enum.Enum):
    """An order of routes, and the key that selects it. All but TABLE have the largest first."""

    TABLE = "table"
    RATE = "rate"
    DROPS = "drops"
    AGE = "age"
    LATENCY = "latency"

    @property
    def key(self) -> str:
        return self.value[0]


@dataclass(frozen=True, slots=True)
class TargetRow:
    """A destination or topic of a route, or the clients of a gateway.

    Delivered messages are in total and per second. `lost` are dropped messages without the intended losses;
    `is_losing`: losses are a problem now.
    """

    name: str
    is_topic: bool
    delivered: int
    rate: float
    dropped: Mapping[str, int]
    filtered: int
    is_losing: bool = False

    @property
    def lost(self) -> dict[str, int]:
        return unwanted(self.dropped)


@dataclass(frozen=True, slots=True)
class RouteRow:
    """A route or a gateway: messages taken in total and per second, and its targets.

    `age` is the time since its last message, `median` and `slowest` (of 100 messages) its latency: seconds, None where
    there is none yet. `is_tripped`: its deadman sends now.
    """

    route: str
    received: int
    rate: float
    targets: tuple[TargetRow, ...]
    age: float | None = None
    median: float | None = None
    slowest: float | None = None
    is_tripped: bool = False

    @property
    def dropped(self) -> dict[str, int]:
        """Dropped messages of all targets by reason."""
        total: dict[str, int] = defaultdict(int)
        for target in self.targets:
            for reason, count in target.dropped.items():
                total[reason] += count
        return dict(total)

    @property
    def lost(self) -> dict[str, int]:
        return unwanted(self.dropped)

    @property
    def is_losing(self) -> bool:
        return any(target.is_losing for target in self.targets)


@dataclass(frozen=True, slots=True)
class View:
    """All routes, and by reason the datagrams that no route took.

    `silence`: seconds since each endpoint sent, None for never. `silent`: the endpoints for which that is a problem.
    `problems`: everything that is wrong, in words; `calm`: what is inactive because nobody drives.
    """

    routes: tuple[RouteRow, ...]
    received: int
    rate: float
    rejected: Mapping[str, int]
    kernel_drops: int
    silence: Mapping[str, float | None] = field(default_factory=dict)
    silent: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()
    calm: tuple[str, ...] = ()
    states: tuple[StateReading, ...] = ()
    services: tuple[ServiceReading, ...] = ()


class Window:
    """The snapshots of the last seconds, of one run of the router."""

    def __init__(self) -> None:
        self._snapshots: deque[Snapshot] = deque()

    def add(self, newest: Snapshot) -> None:
        if self._snapshots and _is_of_another_run(self._snapshots[-1], newest):
            self._snapshots.clear()
        while len(self._snapshots) > 1 and newest.at - self._snapshots[1].at >= WINDOW:
            self._snapshots.popleft()
        self._snapshots.append(newest)

    def clear(self) -> None:
        self._snapshots.clear()

    @property
    def ends(self) -> tuple[Snapshot, Snapshot]:
        """The first and the last snapshot, which may be the same. Raises IndexError before the first `add`."""
        return self._snapshots[0], self._snapshots[-1]


def _is_of_another_run(before: Snapshot, after: Snapshot) -> bool:
    """Return whether the router was restarted: only then do counters decrease."""
    return any(
        after.counts(metric).get(labels, 0.0) < count
        for metric in ("datagrams_received", "messages_received")
        for labels, count in before.counts(metric).items()
    )


def view(
    before: Snapshot, after: Snapshot, problems: Sequence[Problem] = (), states: Sequence[StateReading] = ()
) -> View:
    """Return totals and ages as of `after`, rates per second and latencies since `before`, routes as in the metrics."""
    routes = dict.fromkeys(route for route, _ in after.counts("messages_received"))
    rejected: dict[str, int] = defaultdict(int)
    for (_, reason), count in after.counts("datagrams_rejected").items():
        if count:
            rejected[reason] += int(count)
    heard = {endpoint: seconds for (endpoint,), seconds in after.counts(Kind.ENDPOINT_SILENT.metric).items()}
    unheard = [endpoint for (endpoint,) in after.counts(Kind.ENDPOINT_NEVER_HEARD.metric)]
    silence: dict[str, float | None] = {**heard, **dict.fromkeys(unheard)}
    return View(
        routes=tuple(_route_row(route, before, after, problems) for route in routes),
        received=after.total("datagrams_received"),
        rate=_rate(before, after, "datagrams_received"),
        rejected=dict(rejected),
        kernel_drops=after.total("kernel_drops"),
        silence=silence,
        silent=tuple(name for name in silence if _has(problems, Kind.ENDPOINT_SILENT, endpoint=name)),
        problems=tuple(problem.text for problem in problems if problem.kind.level is not Level.CALM),
        calm=tuple(problem.text for problem in problems if problem.kind.level is Level.CALM),
        states=tuple(states),
        services=tuple(service_readings(after)),
    )


def ordered(rows: Sequence[RouteRow], order: Order) -> tuple[RouteRow, ...]:
    """Return the rows, the largest first, those without a value last; equal rows stay in the order of the table."""
    if order is Order.TABLE:
        return tuple(rows)
    return tuple(sorted(rows, key=lambda row: -_weight(row, order)))


def _weight(row: RouteRow, order: Order) -> float:
    if order is Order.RATE:
        return row.rate
    if order is Order.DROPS:
        return sum(row.lost.values())
    value = row.age if order is Order.AGE else row.slowest
    return value if value is not None else -1.0


def unwanted(reasons: Mapping[str, int]) -> dict[str, int]:
    """Return the unintended losses; those by `max_rate`, for example, are intended."""
    return {reason: count for reason, count in reasons.items() if reason not in INTENDED_REASONS}


def _has(problems: Sequence[Problem], kind: Kind, route: str = "", **labels: str) -> bool:
    """Return whether a problem of this kind has these labels and concerns the route."""
    return any(
        problem.kind is kind and labels.items() <= problem.labels.items() and (not route or route in problem.routes)
        for problem in problems
    )


def _route_row(route: str, before: Snapshot, after: Snapshot, problems: Sequence[Problem]) -> RouteRow:
    latencies = _new_latencies(_latencies(route, before), _latencies(route, after))
    return RouteRow(
        route=route,
        received=after.total("messages_received", route),
        rate=_rate(before, after, "messages_received", route),
        targets=tuple(
            _target_row(metric, route, target, before, after, problems) for metric, target in _targets(route, after)
        ),
        age=after.of("route_silence_seconds", route).get(()),
        median=quantile(latencies, 0.5),
        slowest=quantile(latencies, 0.99),
        is_tripped=_has(problems, Kind.DEADMAN_ACTIVE, route),
    )


def _targets(route: str, after: Snapshot) -> Iterator[tuple[str, str]]:
    """Yield each target, after the metric that counts its messages. For a gateway it counts messages, not packets."""
    is_gateway = bool(after.of("messages_sent", route))
    for metric in DELIVERED:
        if not (is_gateway and metric == "datagrams_sent"):
            for (target,) in after.of(metric, route):
                yield metric, target


def _target_row(
    metric: str, route: str, target: str, before: Snapshot, after: Snapshot, problems: Sequence[Problem]
) -> TargetRow:
    return TargetRow(
        name=target,
        is_topic=metric == "messages_published",
        delivered=after.total(metric, route, target),
        rate=_rate(before, after, metric, route, target),
        dropped=_dropped(route, target, after),
        filtered=after.total("messages_filtered", route, target),
        is_losing=any(_has(problems, kind, route, target=target) for kind in DROPS),
    )


def _dropped(route: str, target: str, snapshot: Snapshot) -> dict[str, int]:
    counts = snapshot.of("messages_dropped", route)
    return {reason: int(count) for (to, reason), count in counts.items() if to == target and count}


def _rate(before: Snapshot, after: Snapshot, metric: str, *labels: str) -> float:
    """Return the increase per second; a restarted router counts from zero."""
    then, now, seconds = before.total(metric, *labels), after.total(metric, *labels), after.at - before.at
    return (now - then if now >= then else now) / seconds if seconds > 0 else 0.0


def _latencies(route: str, snapshot: Snapshot) -> dict[float, float]:
    counts: Counts = snapshot.of(f"route_duration_seconds{BUCKETS}", route)
    return {float(bound): count for (bound,), count in counts.items()}


def _new_latencies(before: Mapping[float, float], after: Mapping[float, float]) -> Mapping[float, float]:
    """Return latencies between the snapshots; all of `after` if there are none, or if the router was restarted."""
    between = {bound: count - before.get(bound, 0.0) for bound, count in after.items()}
    return between if between.get(math.inf, 0.0) > 0 and min(between.values()) >= 0 else after
