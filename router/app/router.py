"""The whole router: routing (`runtime`), other services, reloads, and the order of start and stop."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from types import TracebackType
from typing import TYPE_CHECKING

from router import __version__
from router.app.change import Change
from router.app.counts import ThreadCounts
from router.app.host_names import HostNames
from router.app.image_saver import ImageSaver
from router.app.plane import Plane
from router.app.reloading import Reloader
from router.app.runtime import Runtime
from router.app.watching import InterfaceWatcher, Watcher, watched_files
from router.carrier.events import DeadmanChange, DeadmanEvents
from router.carrier.forwarding import Forwarding
from router.clock import boottime_ns
from router.compiler.compiled_table import CompiledTable
from router.compiler.metrics import Answer, Evidence, Mismatch
from router.compiler.resolution import names, why_unusable
from router.compiler.topics import DIAGNOSTICS
from router.library import library
from router.log import logger
from router.net.doors import Door
from router.net.udp import Listener
from router.observe.obedience import Obedience, Replies
from router.observe.readings import Readings, SeriesFunction
from router.observe.reports import Reporter
from router.observe.running import ReloadResult, Running
from router.observe.snapshot import SERIES, Snapshot
from router.recording.mirror import Mirror
from router.startup_image.head_start import HeadStart
from router.table.addresses import Address, LinkPlace
from router.table.model.settings import HOW_TO_KEEP
from router.threads import DaemonThread, StopStack, background_threads

if TYPE_CHECKING:  # importing prometheus_client would take a tenth of the time until the ports are bound
    from prometheus_client.metrics_core import Metric as Family

    from router.gateway.clients import ClientQueue
    from router.recording.recorder import Recorder
    from router.ros.endpoints import Publication

_TOTALS = (
    "datagrams_received",
    "datagrams_rejected",
    "messages_received",
    "datagrams_sent",
    "messages_published",
    "messages_dropped",
)


class Router:
    """A running program: `with Router(program): ...`, which may be entered once.

    Entering raises StartError, with nothing left open. `ros_args` are passed to rclpy, for example `["--ros-args",
    "-r", "imu_data:=imu"]`. `environ` has the values of the table's variables for reloads (None: process environment).
    The router replaces the image of `head_start`; `saver` saves the program's for the next start. `is_refused`: a
    stored image was not used.
    """

    def __init__(
        self,
        program: CompiledTable,
        ros_args: Sequence[str] = (),
        environ: Mapping[str, str] | None = None,
        head_start: HeadStart | None = None,
        saver: ImageSaver | None = None,
        *,
        is_refused: bool = False,
    ) -> None:
        self.is_ready = False
        self._first = program
        self._start = "refused" if is_refused else "compiled"
        self._reporter = Reporter(self._address_of)
        self._obedience = Obedience()
        self._counts = ThreadCounts(program.counters)
        forwarding = head_start.forwarding if head_start else Forwarding(library(), program.counters.size)
        image = head_start.image if head_start else None
        plane = Plane(forwarding, self._counts, self._reporter, self._of_deadman, program, image)
        self.mirror = Mirror(plane, self._reporter.failed)
        self._runtime = Runtime(plane, forwarding, self._reporter, ros_args, head_start)
        self._services = Services(self, self._runtime.gateways.refused)
        self._saver = saver
        self._reloader = Reloader(self._runtime, environ, self._replaced, saver, lambda: self._host_names.hosts)
        self._host_names = HostNames(
            self._reloader.readdress, self._is_silent, lambda name, host: why_unusable(self.program, name, host)
        )
        self._watcher: Watcher | None = None
        self._interfaces: InterfaceWatcher | None = None
        self._known: Mapping[str, int] = dict.fromkeys(program.table.endpoints, boottime_ns())
        self._readings: tuple[CompiledTable, Readings] | None = None
        self._open = StopStack()

    def __enter__(self) -> Router:
        with StopStack() as opening:
            opening.callback(self._reporter.close)
            self._runtime.close_with(opening)
            services = opening.enter_context(StopStack(opening))  # closed after deadmen have sent a last time
            self._runtime.end_with(opening)
            self._runtime.plane.start_reporting()
            if self._first.table.record is not None:  # for the recorder, which opens later, but records from here on
                self._runtime.plane.observe(is_observed=True)
            change = self._runtime.start(self._first)
            if change.is_same is not None:
                self._start = "kept" if change.is_same else "replaced"
            if change.is_same is False:
                logger.warning("an input has changed since the start: the compiled program replaces the kept one")
            with background_threads():
                self._open_services(change, services)
            self._reloader.open()
            opening.callback(self._unwatch_all)
            opening.callback(self._host_names.close)
            self._watch()
            opening.callback(self._reloader.close)
            self._open = opening.pop_all()
        self.is_ready = True
        program = self.program
        logger.info(
            "router started",
            table=str(program.table.path),
            listening={name: listener.bound_to for name, listener in self.listeners.items()},
            routes=sum(not route.ignore for route in program.table.routes),
            destinations=len(program.senders),
            published=len(program.publishers),
            subscribed=len(program.subscriptions),
        )
        if self._saver is not None and change.image is not None:
            self._saver.save(change.image.image, self._saver.read)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.is_ready = False
        logger.info("router stopping")
        self._open.close()
        logger.info("router stopped", **self.totals())

    def _address_of(self, name: str) -> Address | None:
        """Return the UDP address of an endpoint."""
        endpoint = self.program.table.endpoints.get(name)
        address = endpoint.address.value if endpoint is not None else None
        return None if isinstance(address, LinkPlace) else address

    @property
    def program(self) -> CompiledTable:
        """The running program; a reload replaces it."""
        return self._runtime.program or self._first

    @property
    def listeners(self) -> Mapping[str, Listener]:
        return self._runtime.sockets.listeners

    @property
    def metrics_address(self) -> Address | None:
        """The address of the HTTP server, with the port that the kernel chose for port 0."""
        return self._services.http_address

    def total(self, metric: str) -> int:
        """Return the sum of a counter over all its labels, since the start."""
        return self._counts.total(metric)

    def totals(self) -> dict[str, int]:
        """Return the main counters since the start, over all listeners, routes and targets."""
        totals = {metric: self.total(metric) for metric in _TOTALS}
        return totals | {"kernel_drops": sum(dropped for _, dropped in self._runtime.drops.totals())}

    def mismatches(self) -> Mapping[Mismatch, int]:
        return self._reporter.mismatches()

    def replies(self) -> Replies:
        return self._obedience.replies()

    def progress(self) -> int:
        return self._runtime.plane.turns + self.total("datagrams_received")

    def feed_watchdog(self, notify: int, interval: int) -> None:
        """Feed a watchdog through the connected socket `notify` every `interval` ns; -1 ends that."""
        self._runtime.plane.feed_watchdog(notify, interval)

    def collect(self) -> Iterator[Family]:
        from router.observe.metrics import CountersCollector

        program, readings = self._current_readings()
        build = {
            "version": __version__,
            "table_sha256": program.table.sha256,
            "protos_sha256": program.protos_sha256,
            "start": self._start,
        }
        return CountersCollector(readings, build).collect()

    def read(self, now: int, metrics: Collection[str] = SERIES) -> Snapshot:
        _, readings = self._current_readings()
        return Snapshot(now / 1e9, readings.read(now, metrics))

    def reload(self) -> ReloadResult:
        """Read the table again and adopt it between two datagrams; an invalid one changes nothing."""
        return self._reloader.reload()

    def save_recording(self, reason: str) -> None:
        """Start to save the last datagrams, if the table records them; the result is logged."""
        self._services.save_recording(reason)

    def _open_services(self, change: Change, opening: ExitStack) -> None:
        diagnostics = change.ros.publications.get(DIAGNOSTICS) if change.ros else None
        self._services.open(opening, self._runtime.topics.node_name, diagnostics)
        opening.callback(self.mirror.close)

    def _of_deadman(self, event: DeadmanEvents) -> None:
        match event:
            case DeadmanChange(route, is_tripped):
                self._deadman_changed(route, is_tripped)
            case Answer():
                self._obedience.answered(event, self.program)
                self._services.board_answered(event)
            case Evidence():
                self._obedience.note(event, self.program)

    def _deadman_changed(self, route: str, active: bool) -> None:
        self._obedience.forget(route)
        plans = {plan.route: plan for plan in (*self.program.deadmen, *self.program.client_deadmen)}
        self._reporter.deadman_changed(route, active, plan := plans.get(route))
        if active:
            self._services.deadman_tripped(route, plan.obeyed.endpoints if plan and plan.obeyed else ())
        else:
            self._services.deadman_released(route)

    def _replaced(self) -> None:
        """Follow a reload: the new table may accept what the old one rejected, and names other files and listeners."""
        self._reporter.forget_mismatches()
        self._watch()

    def _watch(self) -> None:
        """Watch network interfaces, host names, and the table's files if the table says so."""
        self._host_names.follow({*names(self.program).values()})
        if self._interfaces is None and self._runtime.sockets.may_lose_interfaces:
            self._interfaces = InterfaceWatcher(lambda: list(self.listeners.values()), self._reloader.reopen)
        if self.program.table.reload_on_change and self._watcher is None:
            self._watcher = Watcher(lambda: watched_files(self.program.table), self.reload)
        elif not self.program.table.reload_on_change:
            self._unwatch()

    def _is_silent(self, host: str) -> bool:
        """Return whether an endpoint with this host name has not been heard for longer than `stale_after`."""
        metric = "endpoint_silence_seconds"
        now = self.read(boottime_ns(), (metric,))
        ours = (self.program.table.endpoints[name] for name, each in names(self.program).items() if each == host)
        limits = {each.name: each.stale_after / 1e9 for each in ours if each.stale_after is not None}
        return any(now.of(metric, name).get((), 0.0) > limit for name, limit in limits.items())

    def _unwatch(self) -> None:
        if self._watcher is not None:
            self._watcher.close()
            self._watcher = None

    def _unwatch_all(self) -> None:
        self._unwatch()
        if self._interfaces is not None:
            self._interfaces.close()

    def _computed_series(self) -> dict[str, SeriesFunction]:
        """Return the series without a counter, whose values are computed at each scrape."""

        def of_clients(value: Callable[[ClientQueue], float]) -> SeriesFunction:
            return lambda: gateways.clients(value) if (gateways := self._runtime.gateways.thread) else ()

        return {
            **self._services.computed_series(),
            "connections_refused": lambda: [
                ((server,), n) for server, n in list(self._runtime.gateways.refused.items())
            ],
            "endpoint_unresolved": lambda: [
                ((name,), self.program.table.endpoints[name].address.value.is_name) for name in names(self.program)
            ],
            "kernel_drops": lambda: [((name,), dropped) for name, dropped in self._runtime.drops.totals()],
            "groups_not_joined": lambda: [
                ((name,), len(each.missing_groups)) for name, each in self.listeners.items() if each.has_groups
            ],
            "listener_waiting": lambda: [((name,), each.lacks_network()) for name, each in self.listeners.items()],
            "publish_stalled_seconds": lambda: [((topic,), each) for topic, each in self._runtime.stalled().items()],
            "state_text": self._runtime.plane.state_texts,
            "topic_subscribers": self._runtime.topics.subscribers,
            "type_incompatible": self._runtime.topics.type_incompatible,
            "other_routers": self._runtime.topics.other_routers,
            "node_namesakes": self._runtime.topics.node_namesakes,
            "gateway_client_lag_seconds": of_clients(lambda client: client.lag(boottime_ns()) / 1e9),
            "gateway_client_sent": of_clients(lambda client: client.sent),
            "gateway_client_dropped": of_clients(lambda client: client.dropped),
        }

    def _current_readings(self) -> tuple[CompiledTable, Readings]:
        if (made := self._readings) is None or made[0] is not self.program:
            program = self.program
            made = self._readings = (program, self._new_readings(program))
        return made

    def _new_readings(self, program: CompiledTable) -> Readings:
        # Use this program's counters: those of the running program are adopted only once no thread is stuck.
        totals, now = partial(self._counts.totals, program.counters.latest()), boottime_ns()
        self._known = {name: self._known.get(name, now) for name in program.table.endpoints}
        return Readings(program.counters, totals, self._computed_series(), self._known)


class Services:
    """The services of the table besides routing: recorder, Foxglove, diagnostics, HTTP."""

    def __init__(self, running: Running, refused: Counter[str]) -> None:
        self.http_address: Address | None = None
        self._running = running
        self._refused = refused
        self._recorder: Recorder | None = None
        self._saving = DaemonThread("saving")

    def open(self, opening: ExitStack, node: str, diagnostics: Publication | None) -> None:
        """Open the services; `opening` closes them. Raises StartError. `node`: the node's name."""
        running, table = self._running, self._running.program.table
        if table.record is not None:
            from router.recording.recorder import Recorder

            self._recorder = Recorder(running.mirror, lambda: running.program, table.record)
            opening.callback(self._recorder.close)
            opening.callback(self._saving.shutdown)
        if table.foxglove is not None:
            from router.observe.foxglove import FoxgloveServer

            door = Door("foxglove", table.foxglove.networks, self._refused)
            opening.callback(FoxgloveServer(table.foxglove, door, running).close)
        if diagnostics is None and table.http is None:
            return
        from router.observe.watch import Health

        health = Health(running)
        opening.callback(health.close)
        if diagnostics is not None:
            from router.observe.diagnostics import Diagnostics

            publish, demand = diagnostics.publish, diagnostics.demand
            opening.callback(Diagnostics(health, node, publish, lambda: bool(demand.wanted)).close)
        if table.http is not None:
            from router.observe.http import HttpServer

            save = self._recorder.save if self._recorder and table.record and table.record.last else None
            door = Door("http", table.http.networks, self._refused)
            address = table.http.address
            server = HttpServer(address.value, address.span, door, running, health, save)
            opening.callback(server.close)
            self.http_address = server.address

    def computed_series(self) -> Mapping[str, SeriesFunction]:
        """Return the series of the services and of the table."""

        def recorded(metric: str) -> SeriesFunction:
            return lambda: self._recorder.samples()[metric] if self._recorder else ()

        metrics = "recorded_datagrams", "recorded_bytes", "record_dropped", "recordings_unsaved", "recordings_lost"
        own = {metric: recorded(metric) for metric in metrics}
        return {**own, "endpoint_stale_after_seconds": self._stale_after}

    def _stale_after(self) -> Iterator[tuple[tuple[str, str], float]]:
        for endpoint in self._running.program.table.endpoints.values():
            if endpoint.stale_after is not None:
                yield (endpoint.name, endpoint.kind.value), endpoint.stale_after / 1e9

    def deadman_tripped(self, route: str, awaited: Iterable[str]) -> None:
        """Save the last datagrams once the `awaited` boards have answered. Returns at once, as the next two do."""
        if self._recorder is not None:
            self._recorder.deadman_tripped(route, awaited)

    def board_answered(self, answer: Answer) -> None:
        if self._recorder is not None:
            after = f"{answer.after / 1e9:.2f} s"
            said = f"stopped after {after}" if answer.obeys else f"did not obey for {after}"
            self._recorder.board_answered(answer.route, answer.endpoint, said)

    def deadman_released(self, route: str) -> None:
        if self._recorder is not None:
            self._recorder.deadman_released(route)

    def save_recording(self, reason: str) -> None:
        """Start to save, and return at once; the result is logged. Not thread-safe.

        A request is ignored while an earlier one has not begun.
        """
        if self._recorder is None:
            logger.warning("nothing to save: the table keeps no datagrams", remedy=HOW_TO_KEEP)
            return
        if not self._saving.has_waiting():
            try:
                self._saving.submit(_save, self._recorder, reason)
            except (RuntimeError, MemoryError) as error:  # no thread can be started
                logger.error("cannot save the last datagrams", problem=str(error))


def _save(recorder: Recorder, reason: str) -> None:
    from router.recording.recorder import RecordError

    try:
        recorder.save(reason)
    except RecordError as error:
        logger.error("cannot save the last datagrams", problem=str(error))
