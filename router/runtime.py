"""Wires a program to its edges: opens everything, runs, stops. Knows what belongs together, and does no work itself."""

from __future__ import annotations

import gc
import sys
import threading
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from types import TracebackType

from router.compiler.program import Program
from router.edges.background import background_threads
from router.edges.clock import monotonic_ns, wall_ns
from router.edges.log import SUMMARY_INTERVAL_NS, FloodLog, logger
from router.edges.metrics import BooksCollector, MetricsServer
from router.edges.receiver import ReceiveThread
from router.edges.udp import Listener, Sender
from router.engine import MAX_DATAGRAM, Engine, Report
from router.errors import StartError
from router.table.model import Address


class Router:
    """A running program: `with Router(program): ...`. Entering raises StartError, and then nothing is left open.

    `ros_args` go to rclpy as they are (`["--ros-args", "-r", "imu_data:=imu"]`). A router runs once.
    """

    def __init__(self, program: Program, ros_args: Sequence[str] = ()) -> None:
        self.program = program
        self.counts = program.books.fresh_counts()
        self.listeners: dict[str, Listener] = {}
        self.metrics_address: Address | None = None
        self._ros_args = ros_args
        self._floods = FloodLog()
        self._stopped = threading.Event()
        self._open_edges = ExitStack()

    def __enter__(self) -> Router:
        with ExitStack() as opening:
            with background_threads():
                engine = self._open(opening)
            self._start_receiving(engine, opening)
            self._open_edges = opening.pop_all()
        table = self.program.table
        logger.info(
            "router started",
            table=str(table.path),
            listening={name: str(listener.address) for name, listener in self.listeners.items()},
            routes=len(self.program.inbound),
            destinations=len(self.program.senders),
            topics=len(self.program.publishers),
            metrics=str(self.metrics_address) if self.metrics_address else None,
        )
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        logger.info("router stopping")
        self._open_edges.close()
        logger.info("router stopped", **self.totals())

    def totals(self) -> dict[str, int]:
        """What happened since the start, over all listeners, routes and targets."""
        totals = dict.fromkeys(
            ("datagrams_received", "datagrams_rejected", "datagrams_sent", "messages_published", "messages_dropped"), 0
        )
        for series, slot in self.program.books.series():
            if series.metric in totals:
                totals[series.metric] += self.counts[slot]
        return totals | {"kernel_drops": sum(listener.kernel_drops() for listener in self.listeners.values())}

    def _open(self, opening: ExitStack) -> Engine:
        """Everything but receiving. `opening` closes in the opposite order."""
        program, table = self.program, self.program.table
        opening.callback(self._floods.flush, final=True)
        for plan in program.listeners:
            listener = Listener(plan, table.listeners[plan.name].address.span)
            opening.callback(listener.close)
            self.listeners[plan.name] = listener
        send = {}
        for destination in program.senders:
            sender = Sender(destination, table.endpoints[destination.endpoint].address.span)
            opening.callback(sender.close)
            send[destination.endpoint] = sender.send
        bind = partial(Engine, program, self.counts, send, report=self._report, clock_ns=monotonic_ns, wall_ns=wall_ns)
        if program.publishers:
            try:  # here, because a table without topics runs where there is no ROS
                from router.edges.ros import PUBLISH_ERRORS, RosEdge
            except ImportError as error:
                remedy = "run 'make setup', or source the setup.sh of an installed ROS 2 Jazzy"
                raise StartError(f"{table.path} has topics, and ROS 2 cannot be loaded: {error}; {remedy}") from error

            spans = {topic.topic.value: topic.topic.span for route in table.routes for topic in route.topics}
            ros = RosEdge(table.node, program.publishers, spans, self._ros_args)
            opening.callback(ros.close)
            engine = bind(ros.publish, ros.wanted, publish_errors=PUBLISH_ERRORS)
        else:
            engine = bind({}, {})
        self._open_metrics(opening)
        teller = threading.Thread(target=self._tell_of_floods, name="log")
        teller.start()
        opening.callback(teller.join)
        opening.callback(self._stopped.set)
        return engine

    def _start_receiving(self, engine: Engine, opening: ExitStack) -> None:
        receive = {name: engine.receiver(name) for name in self.listeners}
        receiving = ReceiveThread(list(self.listeners.values()), receive, MAX_DATAGRAM, self._receive_failed)
        receiving.start()
        opening.callback(receiving.stop)

    def _open_metrics(self, opening: ExitStack) -> None:
        program, settings = self.program, self.program.table.metrics
        if settings is None:
            return
        build = {
            "version": _version(),
            "table_sha256": program.table.sha256,
            "protos_sha256": program.protos_sha256,
        }
        kernel_drops = {name: listener.kernel_drops for name, listener in self.listeners.items()}
        collector = BooksCollector(program.books, [self.counts], kernel_drops, build)
        server = MetricsServer(settings.value, settings.span, collector)
        opening.callback(server.close)
        self.metrics_address = server.address

    def _tell_of_floods(self) -> None:
        while not self._stopped.wait(SUMMARY_INTERVAL_NS / 1e9):
            self._floods.flush()

    def _report(self, report: Report) -> None:
        """The engine counted a loss; this says so in the log."""
        if report.kind == "reject":
            key = (report.place, report.reason)
            self._floods.note(
                key,
                logger.warning,
                "datagram rejected",
                listener=report.place,
                reason=report.reason,
                detail=report.detail,
            )
            return
        # A traceback through generated code shows the line of the route table; others would show only the router.
        traceback = report.error if report.reason in ("mapping_error", "non_finite") else None
        self._floods.note(
            (report.place, report.target, report.reason),
            logger.warning,
            "message dropped",
            traceback,
            route=report.place,
            target=report.target,
            reason=report.reason,
            error=str(report.error),
        )

    def _receive_failed(self, error: Exception) -> None:
        self._floods.note(
            ("bug", type(error)),
            logger.critical,
            "a fault in the router itself lost a datagram; please report it",
            error,
        )


def _version() -> str:
    try:
        return version("rover-router")
    except PackageNotFoundError:  # run from a checkout that is not installed
        return "unknown"


def tune_interpreter() -> None:
    """Settings of the whole process, for whoever owns it: call once, after start, before traffic."""
    gc.freeze()  # what start-up made lives as long as the process: the collector need not look at it again
    sys.setswitchinterval(0.0005)  # the receive thread waits no longer than this for a busy thread to let it in
