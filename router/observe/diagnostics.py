"""`/diagnostics`, once per second: one status for the router and each listener, endpoint, route and gateway."""

from __future__ import annotations

import enum
import platform
import struct
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from router.clock import boottime_ns, wall_ns
from router.compiler.cdr.primitives import HEADER, put_length, put_text
from router.compiler.metrics import INTENDED_REASONS, RECORD_DROP_REASONS
from router.compiler.program import GatewayPlan, Program
from router.log import logger
from router.observe.running import Running
from router.observe.snapshot import MOST_STALLED, Labels, Snapshot, snapshot
from router.table.model import Endpoint, Route
from router.threads import Thread, background_threads, join_or_leave

PERIOD = 1.0
"""Seconds."""
SNAPSHOTS = 6
"""What went wrong is reported for so many periods, less one: a status that comes and goes would be overlooked."""

LAST_SEEN = "endpoint_last_seen_timestamp_seconds"
STALLED = "publish_stalled_seconds"
METRICS = frozenset(
    {
        "config_last_reload_successful",
        "datagrams_received",
        "datagrams_rejected",
        "datagrams_sent",
        "deadman_active",
        "deadman_datagrams_sent",
        "deadman_send_errors",
        LAST_SEEN,
        "gateway_clients",
        "listener_waiting",
        "gateway_topics",
        "kernel_drops",
        "messages_dropped",
        "messages_published",
        "messages_received",
        "messages_sent",
        "messages_waiting",
        "mirror_dropped",
        STALLED,
        "record_dropped",
    }
)
"""What is read each second. Histograms, which are most of what is counted, are not."""

ERRORS = frozenset({"send_error", "publish_error"})
"""Drop reasons that say that something is broken."""


_DELIVERED = ("messages_published", "datagrams_sent")
"""The metrics of what a target got."""


class Level(enum.IntEnum):
    """As in diagnostic_msgs/msg/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


_SEVERITY = (Level.OK, Level.WARN, Level.STALE, Level.ERROR)


class Status(NamedTuple):
    """One DiagnosticStatus; `name` without the node's."""

    level: Level
    name: str
    message: str
    hardware_id: str
    values: tuple[tuple[str, str], ...]


class Problem(NamedTuple):
    level: Level
    text: str


class Diagnostics:
    """A thread that calls `publish` with the CDR bytes of a DiagnosticArray each PERIOD until it is closed."""

    def __init__(self, running: Running, node: str, publish: Callable[[bytes], None]) -> None:
        """`node` is the name of the router in each status."""
        self._node = node
        self._watch = Watch(running)
        self._publish = publish
        self._stopping = threading.Event()
        self._thread = Thread(self._run, "diagnostics")
        with background_threads():
            self._thread.start()

    def close(self) -> None:
        self._stopping.set()
        join_or_leave(self._thread)

    def _run(self) -> None:
        has_failed = False
        while not self._stopping.wait(PERIOD):
            try:
                statuses = self._watch.statuses(boottime_ns(), wall_ns())
                self._publish(diagnostic_array(wall_ns(), self._node, statuses))
            except Exception as error:  # noqa: BLE001 routing goes on without diagnostics
                if not has_failed:
                    logger.error("diagnostics cannot be published", problem=repr(error))
                has_failed = True
            else:
                has_failed = False


class Watch:
    """Compares the numbers with those SNAPSHOTS periods ago, and measures for how long endpoints are silent."""

    def __init__(self, running: Running) -> None:
        self._running = running
        self._host = platform.node()
        self._snapshots: deque[tuple[int, Snapshot]] = deque(maxlen=SNAPSHOTS)
        self._last_seen: dict[str, tuple[float, int]] = {}  # by endpoint: the stamp, and when that was (boot clock)

    def statuses(self, now: int, wall: int) -> list[Status]:
        """How everything is at `now`, of the boot clock, and `wall`, in ns."""
        program, latest = self._running.program, snapshot(self._running.collect(), now / 1e9, METRICS)
        earlier = self._snapshots[-1][0] if self._snapshots else now
        silent = {name: now - self._seen(name, latest, earlier, now, wall) for name in program.table.endpoints}
        self._snapshots.append((now, latest))
        since, before = self._snapshots[0]
        report = Report(program, latest, before, max(now - since, 1) / 1e9, silent, self._stalled(), self._host)
        return [*report.statuses()]

    def _stalled(self) -> dict[str, float]:
        """For how many seconds each topic's publisher is stuck, or was within the last periods, call by call."""
        snapshots = [each.counts(STALLED) for _, each in self._snapshots]
        return {
            topic: max(seconds, sum(min(each.get((topic,), 0.0), PERIOD) for each in snapshots))
            for (topic,), seconds in snapshots[-1].items()
        }

    def _seen(self, endpoint: str, latest: Snapshot, earlier: int, now: int, wall: int) -> int:
        """When it was last heard of, or first looked for. Stamps are of the wall clock, which jumps."""
        stamp = latest.of(LAST_SEEN, endpoint).get((), 0.0)
        if endpoint not in self._last_seen or self._last_seen[endpoint][0] != stamp:
            age = min(max(0, wall - int(stamp * 1e9)), now - earlier)
            self._last_seen[endpoint] = stamp, now - age
        return self._last_seen[endpoint][1]


@dataclass(frozen=True, slots=True)
class Report:
    """The statuses that follow from two snapshots, `seconds` apart.

    `silent`: for how long each endpoint is silent, ns. `stalled`: for how long the publisher of each topic is stuck, s.
    `host` names this computer.
    """

    program: Program
    now: Snapshot
    before: Snapshot
    seconds: float
    silent: Mapping[str, int]
    stalled: Mapping[str, float]
    host: str

    def statuses(self) -> Iterator[Status]:
        """The router's own first."""
        table = self.program.table
        yield self._router()
        for listener in table.listeners:
            yield self._listener(listener)
        for endpoint in table.endpoints.values():
            yield self._endpoint(endpoint)
        for route in table.routes:
            if not route.ignore:
                yield self._route(route)
        for gateway in self.program.gateways:
            yield self._gateway(gateway)

    def _router(self) -> Status:
        table = self.program.table
        problems = [
            *(
                _warning(f"the recording lacks {n}: {reason}")
                for reason in RECORD_DROP_REASONS
                for _, n in self._grown("record_dropped", reason)
            ),
            *(_warning(f"recordings and taps were not shown {n}") for _, n in self._grown("mirror_dropped")),
            *(
                Problem(Level.ERROR, f"publishing on {topic} is stuck in the ROS middleware, for {seconds:.1f} s")
                for topic, seconds in self.stalled.items()
                if seconds > MOST_STALLED
            ),
        ]
        if not self.now.total("config_last_reload_successful"):
            problems.append(_warning("the last reload failed, and the table from before it goes on"))
        values = [
            ("table", table.path.name),
            ("table sha256", table.sha256),
            ("protos sha256", self.program.protos_sha256),
        ]
        return _status("router", self.host, problems, "routing", values)

    def _listener(self, name: str) -> Status:
        problems = [_warning(f"the kernel dropped {n}") for _, n in self._grown("kernel_drops", name)]
        if self.now.total("listener_waiting", name):
            problems.insert(0, Problem(Level.ERROR, "its address or network interface is not there: nothing comes in"))
        problems += self._rejections(name)
        values = [
            ("address", self.program.table.listeners[name].bound_to),
            ("received", self.now.total("datagrams_received", name)),
            ("dropped by the kernel", self.now.total("kernel_drops", name)),
            *((f"rejected: {reason}", n) for (reason,), n in self._counted("datagrams_rejected", name)),
        ]
        return _status(f"listener/{name}", self.host, problems, "receives what arrives", values)

    def _endpoint(self, endpoint: Endpoint) -> Status:
        name, routes = endpoint.name, self.program.table.routes
        speaks = any(source.value == name for route in routes for source in route.sources)
        problems = [self._stale(name)] if speaks and self._is_stale(endpoint) else []
        to_it = [route.name for route in routes if any(to.endpoint.value == name for to in route.destinations)]
        problems += _drops(_summed(name, (self._grown("messages_dropped", route) for route in to_it)))
        problems += [
            _unsent(n, name)
            for route in routes
            for (target,), n in self._grown("deadman_send_errors", route.name)
            if target == name
        ]
        dropped = _summed(name, (self._counted("messages_dropped", route) for route in to_it))
        values = [
            ("address", endpoint.address.value),
            ("kind", endpoint.kind.value),
            ("silent for", self._silence(name)),
            ("received", self._of_endpoint("messages_received", name)),
            ("sent", self._of_endpoint("datagrams_sent", name)),
            *((f"dropped: {reason}", n) for (_, reason), n in dropped),
        ]
        has_sent = self.now.total(LAST_SEEN, name)
        well = "sends" if has_sent else "nothing came yet" if speaks else "is not expected to send"
        return _status(f"endpoint/{name}", str(endpoint.address.value), problems, well, values)

    def _route(self, route: Route) -> Status:
        name, endpoints = route.name, self.program.table.endpoints
        sources = [endpoints[source.value] for source in route.sources if source.value in endpoints]
        problems = self._deadman(name)
        if sources and all(self._is_stale(source) for source in sources):
            problems += [self._stale(source.name) for source in sources]
        problems += [*_drops(self._grown("messages_dropped", name)), *self._stalled(name)]
        received = self.now.total("messages_received", name)
        fresh = sum(n for _, n in self._grown("messages_received", name))
        values = [
            ("received", received),
            ("received per second", f"{fresh / self.seconds:.1f}"),
            *((f"sent to {target}", n) for (target,), n in self._counted("datagrams_sent", name)),
            *((f"published on {topic}", n) for (topic,), n in self._counted("messages_published", name)),
            *((f"waiting for {target}", n) for (target,), n in self._counted("messages_waiting", name)),
            *self._dropped(name),
            *((f"sent by the deadman to {to}", n) for (to,), n in self._counted("deadman_datagrams_sent", name)),
        ]
        return _status(f"route/{name}", self.host, problems, "routes" if received else "nothing came yet", values)

    def _gateway(self, gateway: GatewayPlan) -> Status:
        name = gateway.settings.name
        problems = [*self._rejections(name), *_drops(self._grown("messages_dropped", name))]
        for inbound in gateway.inbound.values():
            if inbound.deadman is not None:
                problems += self._deadman(inbound.deadman.route)
        values = [
            ("clients", self.now.total("gateway_clients", name)),
            *((f"topics {state}", n) for (state,), n in self._counted("gateway_topics", name)),
            ("sent", self.now.total("messages_sent", name)),
            *((f"received from {source}", n) for (source,), n in self._counted("messages_received", name)),
            *((f"rejected: {reason}", n) for (reason,), n in self._counted("datagrams_rejected", name)),
            *self._dropped(name),
        ]
        return _status(f"gateway/{name}", self.host, problems, "serves its clients", values)

    def _rejections(self, listener: str) -> list[Problem]:
        grown = self._grown("datagrams_rejected", listener)
        return [_warning(f"rejected {n}: {reason}") for (reason,), n in grown if reason not in INTENDED_REASONS]

    def _deadman(self, route: str) -> list[Problem]:
        problems = [_unsent(n, target) for (target,), n in self._grown("deadman_send_errors", route)]
        if self.now.total("deadman_active", route):
            problems.append(Problem(Level.ERROR, "commands stopped coming: the deadman sends in their place"))
        return problems

    def _stalled(self, route: str) -> Iterator[Problem]:
        """Targets for which messages have waited all the time, and that got none."""
        waited = self.before.of("messages_waiting", route)
        served = {rest for metric in _DELIVERED for rest, _ in self._grown(metric, route)}
        for rest, n in self._counted("messages_waiting", route):
            if waited.get(rest) and rest not in served:
                yield _warning(f"{n} wait for {rest[0]}, which is stuck")

    def _is_stale(self, endpoint: Endpoint) -> bool:
        return endpoint.stale_after is not None and self.silent.get(endpoint.name, 0) > endpoint.stale_after

    def _stale(self, endpoint: str) -> Problem:
        return Problem(Level.STALE, f"{endpoint} is silent for {self._silence(endpoint)}")

    def _silence(self, endpoint: str) -> str:
        since = "" if self.now.total(LAST_SEEN, endpoint) else ", since the router started"
        return f"{self.silent.get(endpoint, 0) / 1e9:.1f} s{since}"

    def _dropped(self, route: str) -> Iterator[tuple[str, int]]:
        for (target, reason), n in self._counted("messages_dropped", route):
            yield f"dropped for {target}: {reason}", n

    def _of_endpoint(self, metric: str, endpoint: str) -> int:
        """Over all routes. The endpoint is the second label."""
        return int(sum(value for labels, value in self.now.counts(metric).items() if labels[1] == endpoint))

    def _counted(self, metric: str, first: str) -> Iterator[tuple[Labels, int]]:
        """The series that are not 0, by the labels behind the first."""
        return ((rest, int(value)) for rest, value in self.now.of(metric, first).items() if value)

    def _grown(self, metric: str, first: str = "") -> Iterator[tuple[Labels, int]]:
        """The series that have counted meanwhile, and how much."""
        earlier = self.before.of(metric, first)
        for rest, value in self.now.of(metric, first).items():
            if value > (before := earlier.get(rest, 0)):
                yield rest, int(value - before)


def _status(
    name: str, host: str, problems: Iterable[Problem], well: str, values: Iterable[tuple[str, object]]
) -> Status:
    """The worst problem gives the level; the message has all of them."""
    found = sorted(problems, key=lambda problem: -_SEVERITY.index(problem.level))
    level = found[0].level if found else Level.OK
    message = "; ".join(problem.text for problem in found) or well
    return Status(level, name, message, host, tuple((key, str(value)) for key, value in values))


def _warning(text: str) -> Problem:
    return Problem(Level.WARN, text)


def _drops(grown: Iterable[tuple[Labels, int]]) -> list[Problem]:
    """Of series whose other labels are target and reason."""
    return [
        Problem(Level.ERROR if reason in ERRORS else Level.WARN, f"dropped {n} for {target}: {reason}")
        for (target, reason), n in grown
        if reason not in INTENDED_REASONS
    ]


def _unsent(times: int, target: str) -> Problem:
    return Problem(Level.ERROR, f"the deadman could not send {times} to {target}")


def _summed(target: str, routes: Iterable[Iterable[tuple[Labels, int]]]) -> list[tuple[Labels, int]]:
    """What several routes have for a target, the first of the labels: one for each combination of labels."""
    sums: dict[Labels, int] = {}
    for counts in routes:
        for labels, count in counts:
            if labels[0] == target:
                sums[labels] = sums.get(labels, 0) + count
    return [*sums.items()]


def diagnostic_array(stamp: int, node: str, statuses: Iterable[Status]) -> bytes:
    """CDR, with its header. `stamp` in ns of the wall clock."""
    every = list(statuses)
    data = bytearray(struct.pack("<iI", stamp // 10**9, stamp % 10**9))
    put_text(data, "")
    put_length(data, len(every), None)
    for status in every:
        data.append(status.level)
        for text in (f"{node}: {status.name}", status.message, status.hardware_id):
            put_text(data, text)
        put_length(data, len(status.values), None)
        for pair in status.values:
            for text in pair:
                put_text(data, text)
    return HEADER + data
