"""The thread in which all gateways of a router live, with its event loop."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Coroutine, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from router.compiler.books import Books
from router.compiler.program import GatewayPlan
from router.edges.gateway_tcp import TcpTransport
from router.edges.gateway_transport import Ears, Transport
from router.edges.gateway_udp import UdpTransport
from router.edges.gateway_websocket import WebsocketTransport
from router.edges.ros_topics import RosTopics
from router.errors import StartError
from router.gateway.feeds import Hub
from router.gateway.inlet import Inlet, InletOutlets
from router.gateway.ledger import Ledger
from router.gateway.service import GatewayService
from router.gateway.style import Style
from router.gateway.topics import Surroundings
from router.table.model import Gateway, GatewayFormat
from router.table.model import Transport as Way
from router.types.ros import RosInterfaces

T = TypeVar("T")

PAGE = Path(__file__).with_name("page.html")


class GatewayThread:
    """Opens the gateways of a program when it is made, and serves them from `start` on. Raises StartError.

    `counts` belong to its thread, in which all that `outlets` has is called.
    """

    def __init__(
        self,
        plans: Sequence[GatewayPlan],
        ros: RosTopics,
        interfaces: RosInterfaces,
        books: Books,
        counts: list[int],
        outlets: InletOutlets,
        failed: Callable[[Exception], None],
    ) -> None:
        self._failed = failed
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="gateway bulk")
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(self._on_fault)
        self._thread = threading.Thread(target=self._loop.run_forever, name="gateway")
        self._services: list[GatewayService] = []
        self._hub = Hub(ros, interfaces, self._loop)
        self._around = Surroundings(self._hub, self._worker, outlets.report, failed, outlets.clock_ns, outlets.wall_ns)
        self._thread.start()
        try:
            for plan in plans:
                self._call(self._open(plan, books, counts, outlets))
        except BaseException:
            self.stop()
            raise

    async def _open(self, plan: GatewayPlan, books: Books, counts: list[int], outlets: InletOutlets) -> None:
        settings = plan.settings
        style = Style.PLAIN if settings.format in (GatewayFormat.JSON, GatewayFormat.JSON_LINES) else Style.WRAPPED
        ledger = Ledger(settings, books, counts, outlets.report)
        inlet = Inlet(plan, style, books, counts, outlets)
        service = GatewayService(plan, self._around, ledger, inlet, lambda ears: _transport(settings, ears))
        try:
            await service.open()
        except StartError as error:
            raise StartError(
                f"{settings.transport.span}: gateway '{settings.name}' cannot be opened: {error}"
            ) from error
        self._services.append(service)

    def start(self) -> None:
        self._call(self._start())

    async def _start(self) -> None:
        for service in self._services:
            service.start()

    def clients(self) -> Iterator[tuple[str, str, float, int, int]]:
        """Of each client now: gateway, number, lag in seconds, frames sent and dropped. For any thread."""
        now = self._around.clock_ns()
        for service in self._services:
            for each in list(service.audience.subscribers.values()):
                yield service.name, str(each.number), each.lag(now) / 1e9, each.sent, each.dropped

    def stop(self) -> None:
        """Nothing is received any more when this returns, nor sent."""
        self._call(self._close())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._worker.shutdown()
        self._loop.close()

    async def _close(self) -> None:
        for service in self._services:
            await service.close()
        self._hub.close()

    def _call(self, work: Coroutine[Any, Any, T]) -> T:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result()

    def _on_fault(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """What a callback of the loop raised: a fault of ours."""
        error = context.get("exception")
        self._failed(error if isinstance(error, Exception) else RuntimeError(context["message"]))


def _transport(settings: Gateway, ears: Ears) -> Transport:
    address, most = settings.address, settings.max_message
    if settings.zenoh is not None:
        from router.edges.gateway_zenoh import ZenohTransport  # takes 50 ms to import

        return ZenohTransport(settings.zenoh, ears)
    assert address is not None  # noqa: S101 - the schema wants one for all others
    if settings.transport.value is Way.UDP:
        return UdpTransport(address.value, settings.receive.value if settings.receive else None, ears)
    if settings.transport.value is Way.TCP:
        prefixed = settings.format is GatewayFormat.GATEWAY_V1
        return TcpTransport(address.value, ears, prefixed=prefixed, max_clients=settings.max_clients, most=most)
    text = settings.format is GatewayFormat.JSON
    page = PAGE.read_bytes()
    return WebsocketTransport(address.value, ears, text=text, max_clients=settings.max_clients, most=most, page=page)
