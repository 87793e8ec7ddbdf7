"""The thread and event loop of all gateways of a router."""

from __future__ import annotations

import asyncio
import ctypes
from collections import Counter
from collections.abc import Callable, Coroutine, Iterable, Iterator, Mapping
from concurrent.futures import TimeoutError as FutureTimeoutError
from contextlib import AsyncExitStack
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from router.clock import boottime_ns, wall_ns
from router.compiler.compiled_table import CompiledTable, GatewayPlan
from router.compiler.metrics import Report
from router.errors import StartError
from router.gateway.calls import ClientCalls
from router.gateway.clients import ClientQueue
from router.gateway.context import GatewayContext
from router.gateway.counters import GatewayCounters
from router.gateway.encoding import ENCODINGS
from router.gateway.inbound import InboundOutputs, InboundPublisher
from router.gateway.service import GatewayService
from router.gateway.subscriptions import Subscriptions
from router.gateway.transport.base import Events, Transport
from router.gateway.transport.stream import Limits
from router.gateway.transport.tcp import TcpTransport
from router.gateway.transport.udp import UdpTransport
from router.gateway.transport.websocket import WebsocketTransport
from router.log import logger
from router.net.doors import Door
from router.table.addresses import Address
from router.table.keys import are_same
from router.table.model.gateways import Gateway, GatewayFormat
from router.table.model.gateways import Transport as TransportKind
from router.threads import ACCEPTED_AFTER_CLOSING, DaemonThread, StuckError, Thread, join_or_abandon
from router.types.ros import ros_interfaces

if TYPE_CHECKING:  # which imports rclpy
    from router.ros.router_node import RouterNode

T = TypeVar("T")

MOST_REQUEST = 4096
"""Maximum bytes of a message from a client that may not publish or call: it can only request schemas."""

_PATIENCE_S = 5.0
"""Seconds that a change of gateways may take in the event loop; opening a Zenoh session takes some."""
_PATIENCE_OF_STOP_S = 2.5

PAGE = Path(__file__).with_name("page.html")


@dataclass(frozen=True, slots=True)
class GatewayChange:
    """`services` of the next program by gateway; `opened` ones are new, `unused` ones are closed."""

    services: dict[str, GatewayService]
    opened: list[GatewayService]
    unused: list[GatewayService]


class GatewayThread:
    """Serves the gateways of a program, and changes to those of another one.

    `prepare` opens new gateways, `adopt` closes obsolete ones, `finish` starts the new services; `undo` undoes the
    change instead. `library` is the carrier's. `counts` belong to this thread, which calls all callbacks.
    `kernel_drops` has, for each gateway that receives datagrams, a thread-safe function that returns how many the
    kernel has dropped. `refused` counts refused connections (see Door). `publish_newest`: see GatewayContext.
    """

    def __init__(
        self,
        ros: RouterNode,
        library: ctypes.CDLL,
        counts: list[int],
        report: Callable[[Report], None],
        failed: Callable[[Exception], None],
        refused: Counter[str],
        publish_newest: Callable[[], None],
    ) -> None:
        self.kernel_drops: dict[str, Callable[[], int]] = {}
        self._failed = failed
        self._refused = refused
        self._counts = counts
        self._ros = ros
        self._library = library
        self._report = report
        self._converting = DaemonThread("gateway bulk")
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(self._on_fault)
        self._thread = Thread(self._loop.run_forever, "gateway")
        self._services: dict[str, GatewayService] = {}
        self._subscriptions = Subscriptions(ros.topics, ros_interfaces(), self._loop)
        self._context = GatewayContext(
            self._subscriptions, self._converting, failed, publish_newest, boottime_ns, wall_ns
        )
        self._thread.start()

    def prepare(self, program: CompiledTable, feed: Mapping[str, Callable[[int], None]]) -> GatewayChange:
        """Open the gateways of `program` that are not open yet. Raises StartError; then nothing has changed.

        `feed` has the functions that feed deadmen, by the deadman's route. An unchanged gateway keeps its clients. A
        changed one loses them here: its socket has to be closed before the new one can be opened.
        """
        outputs = InboundOutputs(
            library=self._library,
            publish=self._ros.publish,
            publish_errors=self._ros.publish_errors,
            feed_deadman=feed,
            report=self._report,
            clock_ns=boottime_ns,
            wall_ns=wall_ns,
        )
        return self._call(self._prepare(program, outputs))

    async def _prepare(self, program: CompiledTable, outputs: InboundOutputs) -> GatewayChange:
        kept = {
            plan.settings.name: service
            for plan in program.gateways
            if (service := self._services.get(plan.settings.name))
            and not service.is_closed
            and are_same(service.plan, plan)
        }
        change = GatewayChange(kept, [], [service for service in self._services.values() if service.name not in kept])
        try:
            for plan in program.gateways:
                if plan.settings.name not in kept:
                    for rival in [
                        other for other in change.unused if _exclude_each_other(other.plan.settings, plan.settings)
                    ]:
                        await rival.close()
                    service = await self._open(plan, program, outputs)
                    change.opened.append(service)
                    change.services[service.name] = service
        except BaseException:
            await self._undo(change)
            raise
        return change

    def undo(self, change: GatewayChange) -> None:
        """Close the gateways that `prepare` opened, and reopen those that it closed."""
        self._call(self._undo(change))

    async def _undo(self, change: GatewayChange) -> None:
        await _close(change.opened)
        async with AsyncExitStack() as opening:  # all of them, even if one raises
            for service in change.unused:
                if service.is_closed:
                    opening.push_async_callback(self._open_again, service)

    async def _open_again(self, service: GatewayService) -> None:
        again = service.replacement()
        await again.open()
        again.start()
        self._services[again.name] = again

    def adopt(self, change: GatewayChange) -> None:
        """Close the services of `unused`. `undo` can still reopen them."""
        self._call(_close(change.unused))

    def finish(self, change: GatewayChange) -> None:
        """Start the new services, and forget those of `unused`."""
        self._services = change.services
        for service in change.unused:
            if service.name not in change.services:
                self.kernel_drops.pop(service.name, None)
        self._call(self._start(change))

    async def _start(self, change: GatewayChange) -> None:
        for service in change.opened:
            service.start()

    async def _open(self, plan: GatewayPlan, program: CompiledTable, outputs: InboundOutputs) -> GatewayService:
        settings, counters = plan.settings, program.counters
        http = program.table.http.address.value if program.table.http else None  # fixed while the router runs
        gateway_counters = GatewayCounters(settings, counters, self._counts, outputs.report, boottime_ns)
        inbound = InboundPublisher(plan, ENCODINGS[settings.format](settings), counters, self._counts, outputs)
        calls = ClientCalls(plan, counters, self._counts, outputs, inbound, self._converting, self._ros.open_client)

        def new_transport(events: Events) -> Transport:
            return self._transport(settings, http, events)

        service = GatewayService(plan, self._context, gateway_counters, inbound, calls, new_transport)
        try:
            await service.open()
        except StartError as error:
            raise type(error)(f"{settings.transport.span}: cannot open gateway '{settings.name}': {error}") from error
        return service

    def _transport(self, settings: Gateway, http: Address | None, events: Events) -> Transport:
        door = Door(f"gateways.{settings.name}", settings.networks, self._refused)
        transport = _new_transport(settings, http, events, door)
        if isinstance(transport, UdpTransport) and settings.receive is not None:
            self.kernel_drops[settings.name] = transport.kernel_drops
        return transport

    def clients(self, value: Callable[[ClientQueue], float]) -> Iterator[tuple[tuple[str, str], float]]:
        """Yield gateway and number of each client, and its `value`. Thread-safe."""
        for service in list(self._services.values()):
            for queue in list(service.clients.queues.values()):
                yield (service.name, str(queue.number)), value(queue)

    def stop(self) -> None:
        """Close all gateways and end the thread. If the middleware blocks it, log that and continue."""
        try:
            self._call(_close(self._services.values()), _PATIENCE_OF_STOP_S)
        except StuckError as error:
            logger.error("gateways did not close within the timeout; continuing", why=str(error))
        finally:  # a running thread would keep the process
            self._loop.call_soon_threadsafe(self._subscriptions.close)
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._converting.shutdown()
            if join_or_abandon(self._thread):
                self._loop.close()

    def _call(self, work: Coroutine[Any, Any, T], patience: float = _PATIENCE_S) -> T:
        """Run a coroutine in the loop. Raises StuckError if the loop is blocked, for example by a publish call."""
        done = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return done.result(patience)
        except FutureTimeoutError as error:
            raise StuckError("the gateways are blocked by the ROS middleware") from error

    def _on_fault(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Report an exception of a callback of the loop: a fault of the router."""
        error = context.get("exception")
        if isinstance(error, ValueError) and str(error) == ACCEPTED_AFTER_CLOSING:
            return
        self._failed(error if isinstance(error, Exception) else RuntimeError(context["message"]))


async def _close(services: Iterable[GatewayService]) -> None:
    """Close all services, even if one raises."""
    async with AsyncExitStack() as closing:
        for service in services:
            closing.push_async_callback(service.close)


def _new_transport(settings: Gateway, http: Address | None, events: Events, door: Door) -> Transport:
    """Return the transport for a gateway's settings, not open yet. `http` has the status page."""
    most = settings.max_inbound if settings.inbound or settings.calls else MOST_REQUEST
    if settings.zenoh is not None:
        from router.gateway.transport.zenoh import ZenohTransport  # takes 50 ms to import

        return ZenohTransport(settings.zenoh, events, most)
    assert settings.address is not None  # noqa: S101 - the schema requires one for all others
    address = settings.address.value
    if settings.transport.value is TransportKind.UDP:
        return UdpTransport(address, settings.receive.value if settings.receive else None, events)
    limits = Limits(settings.max_clients, settings.max_clients_per_host, most)
    if settings.transport.value is TransportKind.TCP:
        return TcpTransport(address, events, limits, door, prefixed=settings.format is GatewayFormat.GATEWAY_V1)
    text = settings.format is GatewayFormat.JSON
    return WebsocketTransport(address, events, limits, door, text=text, page=_page(settings.name, http))


def _page(name: str, http: Address | None) -> bytes:
    """Return the page with what its script reads: the gateway's name in its title, and the status page's address."""
    page = PAGE.read_bytes().replace(b"<title>Gateway</title>", b"<title>Gateway %b</title>" % escape(name).encode())
    if http is None:
        return page
    return page.replace(b'<a id="status"', b'<a id="status" data-address="%b"' % str(http).encode())


def _exclude_each_other(one: Gateway, other: Gateway) -> bool:
    """Return whether both need the same name, address or key, so that only one can be open."""
    if one.zenoh and other.zenoh and one.zenoh.key.value == other.zenoh.key.value:
        return True
    wanted = {where.value for where in (other.address, other.receive) if where}
    return one.name == other.name or any(where.value in wanted for where in (one.address, one.receive) if where)
