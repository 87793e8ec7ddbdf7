"""Wires a program to its edges: opens everything, runs, reloads, stops. Does no work itself.

Knows what belongs together: `edges` what routes, `companions` what surrounds it, `reloading` how a table is replaced.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from importlib.metadata import PackageNotFoundError, version
from types import TracebackType
from typing import TYPE_CHECKING

from prometheus_client.metrics_core import Metric as Family

from router.app.accounts import Accounts
from router.app.companions import Companions
from router.app.edges import Change, Edges
from router.app.interpreter import tune_interpreter
from router.app.reloading import Reloader
from router.app.watching import InterfaceWatcher, Watcher, watched_files
from router.app.wiring import Keepers, Surroundings
from router.clock import monotonic_ns
from router.compiler.program import Program
from router.compiler.topics import DIAGNOSTICS
from router.engine import MAX_DATAGRAM
from router.log import logger
from router.net.udp import Listener
from router.observe.metrics import Asked, CountersCollector
from router.observe.reports import Reporter
from router.observe.running import ReloadResult
from router.recording.mirror import Mirror
from router.table.addresses import Address
from router.threads import background_threads

if TYPE_CHECKING:
    from router.gateway.clients import ClientQueue

__all__ = ["Router", "tune_interpreter"]

_TOTALS = (
    "datagrams_received",
    "datagrams_rejected",
    "messages_received",
    "datagrams_sent",
    "messages_published",
    "messages_dropped",
)


class Router:
    """A running program: `with Router(program): ...`. Entering raises StartError, and then nothing is left open.

    `ros_args` go to rclpy as they are (`["--ros-args", "-r", "imu_data:=imu"]`). `environ` has the values of the
    table's variables, for reloads; None means the process environment. A router runs once.
    """

    def __init__(
        self, program: Program, ros_args: Sequence[str] = (), environ: Mapping[str, str] | None = None
    ) -> None:
        self.is_ready = False
        self._first = program
        self._reporter = Reporter()
        self._accounts = Accounts(program.counters)
        self.mirror = Mirror(MAX_DATAGRAM, self._rewire, self._reporter.failed)
        around = Surroundings(self._accounts, Keepers(self._reporter.failed), self._reporter, self._deadman_changed)
        self._edges = Edges(around, ros_args, self.mirror.tee)
        self._companions = Companions(self)
        self._reloader = Reloader(self._edges, self._accounts, environ, self._settled)
        self._watcher: Watcher | None = None
        self._interfaces: InterfaceWatcher | None = None
        self._collector = self._new_collector()
        self._open_edges = ExitStack()

    def __enter__(self) -> Router:
        with ExitStack() as opening:
            opening.callback(self._reporter.close)
            self._edges.close_with(opening)
            companions = opening.enter_context(ExitStack())  # they close when deadmen have had their last word
            self._edges.end_with(opening)
            with background_threads():
                change = self._edges.prepare(self._first)
                opening.callback(change.undo.close)
                self._open_companions(change, companions)
            self._edges.start(change, opening)
            self._reloader.open()
            opening.callback(self._unwatch_all)
            self._watch()
            opening.callback(self._reloader.close)
            self._open_edges = opening.pop_all()
        self.is_ready = True
        program = self.program
        logger.info(
            "router started",
            table=str(program.table.path),
            listening={name: listener.bound_to for name, listener in self.listeners.items()},
            routes=sum(not route.ignore for route in program.table.routes),
            gateways=len(program.gateways),
            destinations=len(program.senders),
            published=len(program.publishers),
            subscribed=len(program.subscriptions),
            metrics=str(self.metrics_address) if self.metrics_address else None,
        )
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.is_ready = False
        logger.info("router stopping")
        self._open_edges.close()
        logger.info("router stopped", **self.totals())

    @property
    def program(self) -> Program:
        """What runs now: a reload replaces it."""
        wiring = self._edges.wiring
        return wiring.program if wiring is not None else self._first

    @property
    def listeners(self) -> Mapping[str, Listener]:
        return self._edges.sockets.listeners

    @property
    def metrics_address(self) -> Address | None:
        """Where HTTP is answered, with the port that the kernel chose for port 0."""
        return self._companions.http_address

    def total(self, metric: str) -> int:
        """What was counted under a counter's name since the start, over all its labels."""
        return self._accounts.total(metric)

    def totals(self) -> dict[str, int]:
        """What happened since the start, over all listeners, routes and targets."""
        totals = {metric: self.total(metric) for metric in _TOTALS}
        return totals | {"kernel_drops": sum(dropped for _, dropped in self._accounts.drops.totals())}

    def progress(self) -> int:
        return self._edges.turns + self.total("datagrams_received")

    def collect(self) -> Iterator[Family]:
        return self._collector.collect()

    def reload(self) -> ReloadResult:
        """Reads the table again and takes it over between two datagrams; one that is no good changes nothing."""
        return self._reloader.reload()

    def save_recording(self, reason: str) -> None:
        """Has the last datagrams saved, where the table keeps them; what comes of it is logged."""
        self._companions.save_recording(reason)

    def _open_companions(self, change: Change, opening: ExitStack) -> None:
        diagnostics = change.topics.publications.get(DIAGNOSTICS) if change.topics else None
        self._companions.open(opening, (self._edges.node_name, diagnostics.publish) if diagnostics else None)
        opening.callback(self.mirror.close)

    def _rewire(self) -> None:
        """Somebody began or ceased to watch what is received."""
        self._edges.rewire()

    def _deadman_changed(self, route: str, active: bool) -> None:
        self._reporter.deadman_changed(route, active)
        if active:
            self._companions.deadman_tripped(route)

    def _settled(self) -> None:
        """Another program runs, and the counters are its."""
        self._collector = self._new_collector()
        self._watch()

    def _watch(self) -> None:
        """Watches the table's files, where it asks for that, and the network interfaces that it names."""
        if self._interfaces is None and any(plan.interface for plan in self.program.listeners):
            self._interfaces = InterfaceWatcher(lambda: list(self.listeners.values()), self._reloader.reopen)
        if self.program.table.reload_on_change and self._watcher is None:
            self._watcher = Watcher(lambda: watched_files(self.program.table), self.reload)
        elif not self.program.table.reload_on_change:
            self._unwatch()

    def _unwatch(self) -> None:
        if self._watcher is not None:
            self._watcher.close()
            self._watcher = None

    def _unwatch_all(self) -> None:
        self._unwatch()
        if self._interfaces is not None:
            self._interfaces.close()

    def _asked(self) -> dict[str, Asked]:
        """Series that nobody counts in a index."""

        def of_clients(value: Callable[[ClientQueue], float]) -> Asked:
            return lambda: gateways.clients(value) if (gateways := self._edges.gateways) else ()

        return {
            "mirror_dropped": lambda: [((), self.mirror.lost)],
            **self._companions.asked(),
            "kernel_drops": lambda: [((name,), dropped) for name, dropped in self._accounts.drops.totals()],
            "gateway_client_lag_seconds": of_clients(lambda client: client.lag(monotonic_ns()) / 1e9),
            "gateway_client_sent": of_clients(lambda client: client.sent),
            "gateway_client_dropped": of_clients(lambda client: client.dropped),
        }

    def _new_collector(self) -> CountersCollector:
        program = self.program
        build = {
            "version": _version(),
            "table_sha256": program.table.sha256,
            "protos_sha256": program.protos_sha256,
        }
        return CountersCollector(program.counters, self._accounts.threads, self._asked(), build)


def _version() -> str:
    try:
        return version("rover-router")
    except PackageNotFoundError:  # run from a checkout that is not installed
        return "unknown"
