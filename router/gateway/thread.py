"""The thread in which all gateways of a router live, with its event loop."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextlib import AsyncExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from router.compiler.program import GatewayPlan, Program
from router.edges.clock import monotonic_ns, wall_ns
from router.edges.daemon_thread import DaemonThread
from router.edges.gateway_tcp import TcpTransport
from router.edges.gateway_transport import Ears, Transport
from router.edges.gateway_udp import UdpTransport
from router.edges.gateway_websocket import WebsocketTransport
from router.engine import Report
from router.engine.deadman import Feed
from router.errors import StartError
from router.gateway.encoding import ENCODINGS
from router.gateway.hub import Hub
from router.gateway.inlet import Inlet, InletOutlets
from router.gateway.ledger import Ledger
from router.gateway.service import GatewayService
from router.gateway.subscriber import Subscriber
from router.gateway.surroundings import Surroundings
from router.table.model import Gateway, GatewayFormat
from router.table.model import Transport as Way
from router.types.ros import ros_interfaces

if TYPE_CHECKING:  # which imports rclpy
    from router.edges.ros import RosEdge

T = TypeVar("T")

MOST_ASKED = 4096
"""Bytes of what a client may send that may publish nothing: it can only ask for schemas."""

PAGE = Path(__file__).with_name("page.html")


class GatewayThread:
    """Opens the gateways of a program when it is made, and serves them from `start` on. Raises StartError.

    `counts` belong to its thread, in which all that it is given is called. `feed` makes what tells deadmen.
    `kernel_drops` has what tells that number, for any thread, by gateway that receives datagrams.
    """

    def __init__(
        self,
        program: Program,
        ros: RosEdge,
        counts: list[int],
        feed: Callable[[str, Sequence[str]], Feed],
        report: Callable[[Report], None],
        failed: Callable[[Exception], None],
    ) -> None:
        self.kernel_drops: dict[str, Callable[[], int]] = {}
        self._failed = failed
        self._books = program.books
        self._counts = counts
        self._outlets = _outlets(program, ros, feed, report)
        self._converting = DaemonThread("gateway bulk")
        self._reading = DaemonThread("gateway reading")
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(self._on_fault)
        self._thread = threading.Thread(target=self._loop.run_forever, name="gateway")
        self._services: list[GatewayService] = []
        self._hub = Hub(ros.topics, ros_interfaces(), self._loop)
        self._around = Surroundings(self._hub, self._converting, self._reading, failed, monotonic_ns, wall_ns)
        self._thread.start()
        try:
            for plan in program.gateways:
                self._call(self._open(plan))
        except BaseException:
            self.stop()
            raise

    async def _open(self, plan: GatewayPlan) -> None:
        settings = plan.settings
        style = ENCODINGS[settings.format].style
        ledger = Ledger(settings, self._books, self._counts, self._outlets.report, wall_ns)
        inlet = Inlet(plan, style, self._books, self._counts, self._outlets)
        service = GatewayService(plan, self._around, ledger, inlet, lambda ears: self._transport(settings, ears))
        try:
            await service.open()
        except StartError as error:
            raise StartError(
                f"{settings.transport.span}: gateway '{settings.name}' cannot be opened: {error}"
            ) from error
        self._services.append(service)

    def _transport(self, settings: Gateway, ears: Ears) -> Transport:
        transport = _transport(settings, ears)
        if isinstance(transport, UdpTransport) and settings.receive is not None:
            self.kernel_drops[settings.name] = transport.kernel_drops
        return transport

    def start(self) -> None:
        self._call(self._start())

    async def _start(self) -> None:
        for service in self._services:
            service.start()

    def clients(self, value: Callable[[Subscriber], float]) -> Iterator[tuple[tuple[str, str], float]]:
        """Gateway and number of each client, and what `value` makes of it. For any thread."""
        for service in self._services:
            for each in list(service.audience.subscribers.values()):
                yield (service.name, str(each.number)), value(each)

    def stop(self) -> None:
        """Nothing is received any more when this returns, nor sent."""
        try:
            self._call(self._close())
        finally:  # a thread that goes on would keep the process
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()
            self._converting.shutdown()
            self._reading.shutdown()
            self._loop.close()

    async def _close(self) -> None:
        async with AsyncExitStack() as closing:  # all of them, whatever one raises
            closing.callback(self._hub.close)
            for service in self._services:
                closing.push_async_callback(service.close)

    def _call(self, work: Coroutine[Any, Any, T]) -> T:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result()

    def _on_fault(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """What a callback of the loop raised: a fault of ours."""
        error = context.get("exception")
        self._failed(error if isinstance(error, Exception) else RuntimeError(context["message"]))


def _outlets(
    program: Program, ros: RosEdge, feed: Callable[[str, Sequence[str]], Feed], report: Callable[[Report], None]
) -> InletOutlets:
    inbound = [each for gateway in program.gateways for each in gateway.inbound.values()]
    guarded = [each.deadman.route for each in inbound if each.deadman]
    return InletOutlets(
        publish=ros.publish,
        publish_errors=ros.publish_errors,
        feed_deadman={route: feed(route, (route,)) for route in guarded},
        report=report,
        clock_ns=monotonic_ns,
        wall_ns=wall_ns,
    )


def _transport(settings: Gateway, ears: Ears) -> Transport:
    address = settings.address
    most = settings.max_message if settings.inbound else MOST_ASKED
    if settings.zenoh is not None:
        from router.edges.gateway_zenoh import ZenohTransport  # takes 50 ms to import

        return ZenohTransport(settings.zenoh, ears, most)
    assert address is not None  # noqa: S101 - the schema wants one for all others
    if settings.transport.value is Way.UDP:
        return UdpTransport(address.value, settings.receive.value if settings.receive else None, ears)
    if settings.transport.value is Way.TCP:
        prefixed = settings.format is GatewayFormat.GATEWAY_V1
        return TcpTransport(address.value, ears, prefixed=prefixed, max_clients=settings.max_clients, most=most)
    text = settings.format is GatewayFormat.JSON
    page = PAGE.read_bytes()
    return WebsocketTransport(address.value, ears, text=text, max_clients=settings.max_clients, most=most, page=page)
