"""Publishes `/diagnostics` once per second: for the router, and each listener, endpoint, route, gateway and state."""

from __future__ import annotations

import enum
import platform
import struct
import threading
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

from router.clock import wall_ns
from router.compiler.cdr import HEADER, put_length, put_text
from router.compiler.compiled_table import GatewayPlan, StatePlan
from router.log import logger
from router.observe import problems
from router.observe.health import PERIOD, HealthSnapshot
from router.observe.problems import Kind, Problem
from router.observe.snapshot import Labels
from router.observe.states import present_value
from router.observe.watch import Health
from router.table.model.endpoints import Endpoint
from router.table.model.routes import Route
from router.threads import Thread, background_threads, join_or_abandon
from router.values.printing import age_text


class Level(enum.IntEnum):
    """The levels of diagnostic_msgs/msg/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


_LEVELS = {
    problems.Level.CRITICAL: Level.ERROR,
    problems.Level.WARNING: Level.WARN,
    problems.Level.INFO: Level.OK,
    problems.Level.CALM: Level.OK,
}
_SEVERITY = (Level.OK, Level.WARN, Level.STALE, Level.ERROR)


class Status(NamedTuple):
    """One DiagnosticStatus. `name` does not include the node's."""

    level: Level
    name: str
    message: str
    hardware_id: str
    values: tuple[tuple[str, str], ...]


class Diagnostics:
    """A thread that calls `publish` with the CDR bytes of a DiagnosticArray each PERIOD until it is closed."""

    def __init__(
        self, source: Health, node: str, publish: Callable[[bytes], None], is_wanted: Callable[[], bool]
    ) -> None:
        """`node` is the name of the router in each status. `is_wanted` returns whether anyone subscribes."""
        self._node = node
        self._health = source
        self._publish = publish
        self._is_wanted = is_wanted
        self._stopping = threading.Event()
        self._thread = Thread(self._run, "diagnostics")
        with background_threads():
            self._thread.start()

    def close(self) -> None:
        self._stopping.set()
        join_or_abandon(self._thread)

    def _run(self) -> None:
        has_failed = False
        while not self._stopping.wait(PERIOD):
            if not self._is_wanted():
                continue
            try:
                report = Report(self._health.look())
                self._publish(diagnostic_array(wall_ns(), self._node, report.statuses()))
            except Exception as error:  # noqa: BLE001 routing continues without diagnostics
                if not has_failed:
                    logger.error("cannot publish diagnostics", problem=repr(error))
                has_failed = True
            else:
                has_failed = False


class Report:
    """The statuses of a router at one time."""

    def __init__(self, health: HealthSnapshot) -> None:
        self._health = health
        self._program = health.program
        self._host = platform.node()
        self._by_first: dict[str, dict[str, list[tuple[Labels, int]]]] = {}
        self._fresh = _sums(health.grown("messages_received"), 0)
        self._received, self._sent = (
            _sums(health.now.counts(metric).items(), 1) for metric in ("messages_received", "datagrams_sent")
        )
        self._dropped_for: dict[str, Counter[str]] = defaultdict(Counter)
        for (_, target, reason), n in health.now.counts("messages_dropped").items():
            if n:
                self._dropped_for[target][reason] += int(n)

    def statuses(self) -> Iterator[Status]:
        """Yield all statuses, the router's own first."""
        table = self._program.table
        yield self._router()
        for listener in table.listeners:
            yield self._listener(listener)
        for endpoint in table.endpoints.values():
            yield self._endpoint(endpoint)
        for route in table.routes:
            if not route.ignore:
                yield self._route(route)
        for gateway in self._program.gateways:
            yield self._gateway(gateway)
        for state in self._program.states:
            yield self._state(state)

    def _router(self) -> Status:
        """Return the router's status, with the problems that belong to no listener, endpoint or route."""
        table = self._program.table
        places = {"listener", *_TO_ENDPOINTS}
        problems = (each for each in self._health.problems if not each.routes and not places & each.labels.keys())
        values = [
            ("table", table.path.name),
            ("table sha256", table.sha256),
            ("protos sha256", self._program.protos_sha256),
        ]
        return _status("router", self._host, problems, "routing", values)

    def _listener(self, name: str) -> Status:
        values = [
            ("address", self._program.table.listeners[name].bound_to),
            ("received", self._total("datagrams_received", name)),
            ("dropped by the kernel", self._total("kernel_drops", name)),
            *((f"rejected: {reason}", n) for (reason,), n in self._counted("datagrams_rejected", name)),
        ]
        return _status(
            f"listener/{name}", self._host, self._labelled(name, "listener"), "receives what arrives", values
        )

    def _endpoint(self, endpoint: Endpoint) -> Status:
        name, routes, address = endpoint.name, self._program.table.routes, self._health.address_of(endpoint)
        values = [
            ("address", address),
            ("kind", endpoint.kind.value),
            ("silent for", age_text(self._health.silence.get(name))),
            ("received", self._received[name]),
            ("sent", self._sent[name]),
            *((f"dropped: {reason}", n) for reason, n in self._dropped_for[name].items()),
        ]
        sends = any(source.value == name for route in routes for source in route.sources)
        well = (
            "sends" if self._health.was_heard(name) else "nothing received yet" if sends else "is not expected to send"
        )
        if any(name in away for away in self._health.away.values()):
            well = "is silent: nobody drives"
        problems = self._labelled(name, *_TO_ENDPOINTS)
        return _status(f"endpoint/{name}", address, problems, well, values)

    def _route(self, route: Route) -> Status:
        name, health = route.name, self._health
        received = self._total("messages_received", name)
        values = [
            ("received", received),
            ("received per second", f"{self._fresh[name] / health.seconds:.1f}"),
            *((f"sent to {target}", n) for (target,), n in self._counted("datagrams_sent", name)),
            *((f"published on {topic}", n) for (topic,), n in self._counted("messages_published", name)),
            *((f"waiting for {target}", n) for (target,), n in self._counted("messages_waiting", name)),
            *self._dropped(name),
            *((f"sent by the deadman to {to}", n) for (to,), n in self._counted("deadman_datagrams_sent", name)),
        ]
        well = "routes" if received else "nothing received yet"
        return _status(f"route/{name}", self._host, self._concerning(name), well, values)

    def _gateway(self, gateway: GatewayPlan) -> Status:
        name = gateway.settings.name
        values = [
            ("clients", self._total("gateway_clients", name)),
            *((f"topics {state}", n) for (state,), n in self._counted("gateway_topics", name)),
            ("sent", self._total("messages_sent", name)),
            *((f"received from {source}", n) for (source,), n in self._counted("messages_received", name)),
            *((f"rejected: {reason}", n) for (reason,), n in self._counted("datagrams_rejected", name)),
            *self._dropped(name),
        ]
        problems = [*self._labelled(name, "listener"), *self._concerning(name)]
        return _status(f"gateway/{name}", self._host, problems, "serves its clients", values)

    def _state(self, state: StatePlan) -> Status:
        """Return the value of a state, and for each sender how long ago it last set the state."""
        value = present_value(state, self._health.now)
        ages = self._health.now.counts("state_set_seconds")
        setters = [(source, age) for (name, source), age in ages.items() if name == state.name]
        values = [
            ("value", value),
            ("initial value", state.shown(state.initial)),
            *((f"set by {source}", age_text(age)) for source, age in sorted(setters, key=lambda each: each[1])),
            *((f"dropped: {reason}", n) for reason, n in self._dropped_for[state.label].items()),
            ("changes", self._total("state_changes", state.name)),
        ]
        return _status(f"state/{state.name}", self._host, (), value, values)

    def _labelled(self, name: str, *labels: str) -> list[Problem]:
        return [each for each in self._health.problems if any(each.labels.get(label) == name for label in labels)]

    def _concerning(self, route: str) -> list[Problem]:
        return [each for each in self._health.problems if route in each.routes]

    def _dropped(self, route: str) -> Iterator[tuple[str, int]]:
        for (target, reason), n in self._counted("messages_dropped", route):
            yield f"dropped for {target}: {reason}", n

    def _counted(self, metric: str, first: str) -> Sequence[tuple[Labels, int]]:
        """Return the series that are not 0, by their labels after the first."""
        if metric not in self._by_first:
            found = self._by_first[metric] = defaultdict(list)
            for (of, *rest), value in self._health.now.counts(metric).items():
                if value:
                    found[of].append((tuple(rest), int(value)))
        return self._by_first[metric][first]

    def _total(self, metric: str, first: str) -> int:
        return sum(value for _, value in self._counted(metric, first))


_TO_ENDPOINTS = ("endpoint", "target", "destination")
"""Labels that may name an endpoint."""


def _sums(counts: Iterable[tuple[Labels, float]], label: int) -> Counter[str]:
    """Return the sums of counts by the label at this position."""
    sums: Counter[str] = Counter()
    for labels, value in counts:
        sums[labels[label]] += int(value)
    return sums


def _status(
    name: str, host: str, problems: Iterable[Problem], well: str, values: Iterable[tuple[str, object]]
) -> Status:
    """Make a status. The worst problem gives the level; the message lists all, in their order."""
    found = list(problems)
    level = max(map(_level, found), key=_SEVERITY.index, default=Level.OK)
    message = "; ".join(problem.text for problem in found) or well
    return Status(level, name, message, host, tuple((key, str(value)) for key, value in values))


def _level(problem: Problem) -> Level:
    is_silence = problem.kind in (Kind.ENDPOINT_SILENT, Kind.ENDPOINT_NEVER_HEARD)
    return Level.STALE if is_silence else _LEVELS[problem.kind.level]


def diagnostic_array(stamp: int, node: str, statuses: Iterable[Status]) -> bytes:
    """Return a DiagnosticArray as CDR with its header. `stamp`: wall clock, ns."""
    every = list(statuses)
    data = bytearray(struct.pack("<iI", stamp // 10**9, stamp % 10**9))
    put_text(data, "")
    put_length(data, len(every))
    for status in every:
        data.append(status.level)
        for text in (f"{node}: {status.name}", status.message, status.hardware_id):
            put_text(data, text)
        put_length(data, len(status.values))
        for pair in status.values:
            for text in pair:
                put_text(data, text)
    return HEADER + data
