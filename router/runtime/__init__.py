"""Wires a program to its edges: opens everything, runs, stops. Knows what belongs together, and does no work itself."""

from __future__ import annotations

import gc
import resource
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from types import TracebackType
from typing import TYPE_CHECKING

from prometheus_client.metrics_core import Metric as Family

from router.compiler.program import Program
from router.compiler.topics import DIAGNOSTICS, resolved
from router.edges.background import background_threads
from router.edges.clock import monotonic_ns, wall_ns
from router.edges.coalescing import FOR_SOCKETS, FOR_SUBSCRIBERS
from router.edges.log import logger
from router.edges.metrics import Asked, BooksCollector
from router.edges.mirror import Mirror
from router.edges.receiver import Receive, ReceiveThread
from router.edges.reports import Reporter
from router.edges.running import ReloadResult
from router.edges.timekeeper import Timekeeper
from router.edges.udp import Listener, Sender
from router.engine import MAX_DATAGRAM, Engine, OutboundEngine
from router.engine.binding import Guarded, Outlets
from router.engine.deadman import Deadman, Feed, feeder
from router.engine.pacing import Pacer
from router.errors import StartError
from router.runtime.companions import Companions
from router.table.model import Address

if TYPE_CHECKING:
    from router.edges.ros import RosEdge
    from router.gateway.subscriber import Subscriber
    from router.gateway.thread import GatewayThread

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

    `ros_args` go to rclpy as they are (`["--ros-args", "-r", "imu_data:=imu"]`). A router runs once.
    """

    def __init__(self, program: Program, ros_args: Sequence[str] = ()) -> None:
        self.program = program
        self.listeners: dict[str, Listener] = {}
        self.is_ready = False
        self._kernel_drops: dict[str, Callable[[], int]] = {}  # by listener, and by gateway that receives datagrams
        self._counts: list[list[int]] = []  # one for each thread that counts
        self._ros_args = ros_args
        self._reporter = Reporter()
        self._receivers: dict[str, Receive] = {}
        self._receiving: ReceiveThread | None = None
        self.mirror = Mirror(MAX_DATAGRAM, self._rewire, self._reporter.failed)
        self._companions = Companions(self)
        self._collector: BooksCollector | None = None
        self._open_edges = ExitStack()

    def __enter__(self) -> Router:
        with ExitStack() as opening:
            with background_threads():
                start = self._open(opening)
            start()
            self._open_edges = opening.pop_all()
        self.is_ready = True
        program = self.program
        logger.info(
            "router started",
            table=str(program.table.path),
            listening={name: str(listener.address) for name, listener in self.listeners.items()},
            routes=sum(not route.ignore for route in program.table.routes),
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

    def total(self, metric: str) -> int:
        """What was counted under a counter's name since the start, over all its labels."""
        slots = [slot for series, slot in self.program.books.series() if series.metric == metric]
        return sum(counts[slot] for counts in self._counts for slot in slots)

    def totals(self) -> dict[str, int]:
        """What happened since the start, over all listeners, routes and targets."""
        totals = {metric: self.total(metric) for metric in _TOTALS}
        return totals | {"kernel_drops": sum(dropped() for dropped in self._kernel_drops.values())}

    @property
    def metrics_address(self) -> Address | None:
        """Where HTTP is answered, with the port that the kernel chose for port 0."""
        return self._companions.http_address

    def progress(self) -> int:
        assert self._receiving is not None  # noqa: S101 - it is asked when it has started
        return self._receiving.turns + self.total("datagrams_received")

    def collect(self) -> Iterator[Family]:
        assert self._collector is not None  # noqa: S101 - it is asked when it has started
        return self._collector.collect()

    def samples(self) -> Iterator[tuple[str, dict[str, str], float]]:
        return ((sample.name, sample.labels, sample.value) for family in self.collect() for sample in family.samples)

    def reload(self) -> ReloadResult:
        raise NotImplementedError

    def save_recording(self, reason: str) -> None:
        """Saves the last datagrams, where the table keeps them; what comes of it is logged."""
        self._companions.save_recording(reason)

    def _rewire(self) -> None:
        """Somebody began or ceased to watch what is received."""
        if self._receiving is not None:
            self._receiving.give_to(self._teed())

    def _teed(self) -> dict[str, Receive]:
        return {name: self.mirror.tee(name, receive) for name, receive in self._receivers.items()}

    def _deadman_changed(self, route: str, active: bool) -> None:
        self._reporter.deadman_changed(route, active)
        if active:
            self._companions.deadman_tripped(route)

    def _open(self, opening: ExitStack) -> Callable[[], None]:
        """Opens everything, and returns what starts receiving. `opening` closes in the opposite order.

        Receiving ends first, then open frames, then what waits to be sent; a deadman has the last word.
        """
        program, reporter = self.program, self._reporter
        own = self._fresh_counts()
        own[program.books.slot("config_last_reload_successful")] = 1
        own[program.books.slot("config_last_reload_timestamp_seconds")] = wall_ns()
        opening.callback(reporter.close)
        self._open_listeners(opening)
        send = self._open_senders(opening)
        ros = self._open_ros(opening)
        keepers = [Timekeeper(name, monotonic_ns, reporter.failed) for name in ("deadman", "pacing", "collect")]
        for keeper in keepers:
            opening.callback(keeper.stop)
        deadman, pacing, collecting = keepers
        outlets = Outlets(
            counts=self._fresh_counts(),
            send=send,
            publish=ros.publish if ros else {},
            wanted=ros.wanted if ros else {},
            report=reporter.report,
            clock_ns=monotonic_ns,
            wall_ns=wall_ns,
            pacing=Guarded(self._fresh_counts(), pacing.guard),
            collecting=Guarded(self._fresh_counts(), collecting.guard),
            feed=(feed := feeder(self._deadmen(send, ros), deadman.guard)),
            publish_errors=ros.publish_errors if ros else (),
            pacers=self._pacers(pacing, send),
        )
        inbound = Engine(program, outlets, {name: listener.arrived_at for name, listener in self.listeners.items()})
        outbound = OutboundEngine(program, replace(outlets, counts=self._fresh_counts()))
        self._receivers = {name: inbound.receiver(name) for name in self.listeners}
        subscribed = ros.subscribed if ros else ()
        receiving = self._receiving = ReceiveThread(
            list(self.listeners.values()),
            self._receivers,
            MAX_DATAGRAM,
            lambda: FOR_SUBSCRIBERS if subscribed else FOR_SOCKETS,
            reporter.failed,
        )
        take = {plan.topic: outbound.taker(plan.topic) for plan in program.subscriptions}
        gateways = self._open_gateways(ros, feed, reporter)
        if gateways is not None:
            opening.callback(gateways.stop)
            self._kernel_drops.update(gateways.kernel_drops)
        self._collector = self._new_collector(gateways)
        self._companions.open(opening, ros.publish.get(DIAGNOSTICS) if ros else None)
        opening.callback(self.mirror.close)

        def start() -> None:
            for keeper in keepers:
                keeper.start()
            if gateways is not None:
                gateways.start()
            if ros is not None:
                opening.callback(ros.stop_receiving)
                ros.start(take, reporter.failed)
            receiving.start()
            opening.callback(receiving.stop)

        return start

    def _fresh_counts(self) -> list[int]:
        """For one more thread."""
        self._counts.append(self.program.books.fresh_counts())
        return self._counts[-1]

    def _open_listeners(self, opening: ExitStack) -> None:
        for plan in self.program.listeners:
            listener = Listener(plan, self.program.table.listeners[plan.name].address.span)
            opening.callback(listener.close)
            self.listeners[plan.name] = listener
            self._kernel_drops[plan.name] = listener.kernel_drops

    def _open_senders(self, opening: ExitStack) -> dict[str, Callable[[bytes], int]]:
        send = {}
        for plan in self.program.senders:
            sender = Sender(plan, self.program.table.endpoints[plan.endpoint].address.span)
            opening.callback(sender.close)
            send[plan.endpoint] = sender.send
        return send

    def _open_ros(self, opening: ExitStack) -> RosEdge | None:
        """None where the table has no topics: such a table runs where there is no ROS."""
        program, table = self.program, self.program.table
        if not (program.publishers or program.subscriptions or program.gateways):
            return None
        try:
            from router.edges.ros import RosEdge
        except ImportError as error:
            remedy = "run 'make setup', or source the setup.sh of an installed ROS 2 Jazzy"
            raise StartError(f"{table.path} has topics, and ROS 2 cannot be loaded: {error}; {remedy}") from error
        spans = {topic.topic.value: topic.topic.span for route in table.routes for topic in route.topics}
        for gateway in table.gateways.values():
            for inbound in gateway.inbound:
                spans[resolved(inbound.topic.topic.value, table.node)] = inbound.topic.topic.span
        if table.node.diagnostics is not None:
            spans[DIAGNOSTICS] = table.node.diagnostics
        ros = RosEdge(
            table.node,
            program.publishers,
            program.subscriptions,
            spans,
            self._ros_args,
            self._incompatible(),
        )
        opening.callback(ros.close)
        return ros

    def _incompatible(self) -> Callable[[str, str, int], None]:
        """What counts the peers on a topic that one policy keeps away, for each route that names the topic."""
        books, counts = self.program.books, self._fresh_counts()
        routes: dict[str, list[str]] = {}
        for route in self.program.table.routes:
            for topic in route.topics:
                routes.setdefault(topic.topic.value, []).append(route.name)
        for gateway in self.program.gateways:
            for name in gateway.inbound:
                routes.setdefault(name, []).append(gateway.settings.name)

        def incompatible(topic: str, policy: str, peers: int) -> None:
            for route in routes[topic]:
                counts[books.slot("qos_incompatible", route, topic, policy)] = peers

        return incompatible

    def _deadmen(self, send: Mapping[str, Callable[[bytes], int]], ros: RosEdge | None) -> dict[str, Deadman]:
        """By route; those of what gateways let in send to topics."""
        program, counts = self.program, self._fresh_counts()
        inbound = [each.deadman for gateway in program.gateways for each in gateway.inbound.values() if each.deadman]
        outlets = {
            **send,
            **({topic: _sender(ros, topic) for plan in inbound for topic, _ in plan.datagrams} if ros else {}),
        }
        return {
            plan.route: Deadman(plan, program.books, counts, outlets, self._reporter.report, self._deadman_changed)
            for plan in (*program.deadmen, *inbound)
        }

    def _pacers(self, keeper: Timekeeper, send: Mapping[str, Callable[[bytes], int]]) -> dict[str, Pacer]:
        pacers = {
            plan.endpoint: Pacer(plan.budget, send[plan.endpoint]) for plan in self.program.senders if plan.budget
        }
        for pacer in pacers.values():
            keeper.add(pacer)  # before what hands on to it, so that it is ended after that
        return pacers

    def _open_gateways(
        self, ros: RosEdge | None, feed: Callable[[str, Sequence[str]], Feed], reporter: Reporter
    ) -> GatewayThread | None:
        """Their thread serves nobody before it is started."""
        program = self.program
        if ros is None or not program.gateways:
            return None
        from router.gateway.thread import GatewayThread  # asyncio and websockets take 0.1 s to import

        return GatewayThread(program, ros, self._fresh_counts(), feed, reporter.report, reporter.failed)

    def _asked(self, gateways: GatewayThread | None) -> dict[str, Asked]:
        """Series that nobody counts in a slot."""

        def of_clients(value: Callable[[Subscriber], float]) -> Asked:
            return lambda: gateways.clients(value) if gateways else ()

        return {
            "mirror_dropped": lambda: [((), self.mirror.lost)],
            **self._companions.asked(),
            "kernel_drops": lambda: (((name,), dropped()) for name, dropped in self._kernel_drops.items()),
            "gateway_client_lag_seconds": of_clients(lambda client: client.lag(monotonic_ns()) / 1e9),
            "gateway_client_sent": of_clients(lambda client: client.sent),
            "gateway_client_dropped": of_clients(lambda client: client.dropped),
        }

    def _new_collector(self, gateways: GatewayThread | None) -> BooksCollector:
        program = self.program
        build = {
            "version": _version(),
            "table_sha256": program.table.sha256,
            "protos_sha256": program.protos_sha256,
        }
        return BooksCollector(program.books, self._counts, self._asked(gateways), build)


def _sender(ros: RosEdge, topic: str) -> Callable[[bytes], int]:
    """Publishes as a socket sends: a deadman knows no topics."""

    def send(message: bytes) -> int:
        try:
            ros.publish[topic](message)
        except ros.publish_errors as error:
            raise OSError(f"it cannot be published: {error}") from error
        return len(message)

    return send


def _version() -> str:
    try:
        return version("rover-router")
    except PackageNotFoundError:  # run from a checkout that is not installed
        return "unknown"


def tune_interpreter() -> None:
    """Settings of the whole process, for whoever owns it: call once, after start, before traffic."""
    gc.freeze()  # what start-up made lives as long as the process: the collector need not look at it again
    may_open, may_ask_for = resource.getrlimit(resource.RLIMIT_NOFILE)
    if may_open not in (resource.RLIM_INFINITY, may_ask_for):  # 1024 are too few for as many clients of a gateway
        resource.setrlimit(resource.RLIMIT_NOFILE, (may_ask_for, may_ask_for))
    sys.setswitchinterval(0.0005)  # the receive thread waits no longer than this for a busy thread to let it in
