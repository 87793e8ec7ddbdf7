"""The thread in which all gateways of a router live, with its event loop."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Coroutine, Iterator
from contextlib import AsyncExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

from router.clock import monotonic_ns, wall_ns
from router.compiler.metrics import Counters
from router.compiler.program import GatewayPlan, Program
from router.engine import Report
from router.engine.deadman import FeedMaker
from router.errors import StartError
from router.gateway.encoding import ENCODINGS
from router.gateway.hub import Hub
from router.gateway.inlet import Inlet, InletOutlets
from router.gateway.ledger import Ledger
from router.gateway.service import GatewayService
from router.gateway.subscribers import Subscriber
from router.gateway.surroundings import Surroundings
from router.gateway.transport.base import Events, Transport
from router.gateway.transport.udp import UdpTransport
from router.gateway.transports import new_transport
from router.table.model import Gateway
from router.table.sameness import are_same
from router.threads import DaemonThread
from router.types.ros import ros_interfaces

if TYPE_CHECKING:  # which imports rclpy
    from router.ros.node_and_publishers import RosEdge

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class GatewayChange:
    """`services` are those of the program that comes, by gateway; `opened` are new, nobody wants those of `left`."""

    services: dict[str, GatewayService]
    opened: list[GatewayService]
    left: list[GatewayService]


class GatewayThread:
    """Serves the gateways of one program, or then of another.

    `prepare` opens what is new, `retire` closes what is not wanted any more, `finish` has the new ones serve. Or
    `abandon` undoes it. `counts` belong to its thread, in which all that it is given is called.
    `kernel_drops` has what tells that number, for any thread, by gateway that receives datagrams.
    """

    def __init__(
        self,
        ros: RosEdge,
        counts: list[int],
        report: Callable[[Report], None],
        failed: Callable[[Exception], None],
    ) -> None:
        self.kernel_drops: dict[str, Callable[[], int]] = {}
        self._failed = failed
        self._counts = counts
        self._ros = ros
        self._report = report
        self._converting = DaemonThread("gateway bulk")
        self._reading = DaemonThread("gateway reading")
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(self._on_fault)
        self._thread = threading.Thread(target=self._loop.run_forever, name="gateway")
        self._services: dict[str, GatewayService] = {}
        self._hub = Hub(ros.topics, ros_interfaces(), self._loop)
        self._around = Surroundings(self._hub, self._converting, self._reading, failed, monotonic_ns, wall_ns)
        self._thread.start()

    def prepare(self, program: Program, feed: FeedMaker) -> GatewayChange:
        """Opens what `program` wants and what is not open. Raises StartError, and then all is as it was.

        `feed` makes what tells deadmen. A gateway that is the same as before keeps its clients. One that has changed
        loses them here: its socket has to be closed before the new one can be opened.
        """
        return self._call(self._prepare(program, _outlets(program, self._ros, feed, self._report)))

    async def _prepare(self, program: Program, outlets: InletOutlets) -> GatewayChange:
        kept = {
            plan.settings.name: service
            for plan in program.gateways
            if (service := self._services.get(plan.settings.name))
            and not service.is_closed
            and are_same(service.plan, plan)
        }
        change = GatewayChange(kept, [], [each for each in self._services.values() if each.name not in kept])
        try:
            for plan in program.gateways:
                if plan.settings.name not in kept:
                    for rival in [each for each in change.left if _meet(each.plan.settings, plan.settings)]:
                        await rival.close()
                    service = await self._open(plan, program.counters, outlets)
                    change.opened.append(service)
                    change.services[service.name] = service
        except BaseException:
            await self._abandon(change)
            raise
        return change

    def abandon(self, change: GatewayChange) -> None:
        """Closes what `prepare` opened, and opens what had to make room for it."""
        self._call(self._abandon(change))

    async def _abandon(self, change: GatewayChange) -> None:
        for service in change.opened:
            await service.close()
        async with AsyncExitStack() as opening:  # all of them, whatever one raises
            for service in change.left:
                if service.is_closed:
                    opening.push_async_callback(self._open_again, service)

    async def _open_again(self, service: GatewayService) -> None:
        again = service.anew()
        await again.open()
        again.start()
        self._services[again.name] = again

    def retire(self, change: GatewayChange) -> None:
        """Closes what nobody wants any more; `abandon` would still open it again."""
        self._call(self._retire(change))

    async def _retire(self, change: GatewayChange) -> None:
        async with AsyncExitStack() as closing:  # all of them, whatever one raises
            for service in change.left:
                closing.push_async_callback(service.close)

    def finish(self, change: GatewayChange) -> None:
        """From now on these serve, and no others."""
        self._services = change.services
        for service in change.left:
            if service.name not in change.services:
                self.kernel_drops.pop(service.name, None)
        self._call(self._start(change))

    async def _start(self, change: GatewayChange) -> None:
        for service in change.opened:
            service.start()

    async def _open(self, plan: GatewayPlan, counters: Counters, outlets: InletOutlets) -> GatewayService:
        settings = plan.settings
        ledger = Ledger(settings, counters, self._counts, outlets.report, wall_ns)
        inlet = Inlet(plan, ENCODINGS[settings.format].style, counters, self._counts, outlets)
        service = GatewayService(plan, self._around, ledger, inlet, lambda events: self._transport(settings, events))
        try:
            await service.open()
        except StartError as error:
            raise StartError(
                f"{settings.transport.span}: gateway '{settings.name}' cannot be opened: {error}"
            ) from error
        return service

    def _transport(self, settings: Gateway, events: Events) -> Transport:
        transport = new_transport(settings, events)
        if isinstance(transport, UdpTransport) and settings.receive is not None:
            self.kernel_drops[settings.name] = transport.kernel_drops
        return transport

    def clients(self, value: Callable[[Subscriber], float]) -> Iterator[tuple[tuple[str, str], float]]:
        """Gateway and number of each client, and what `value` makes of it. For any thread."""
        for service in list(self._services.values()):
            for each in list(service.subscribers.by_client.values()):
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
            for service in self._services.values():
                closing.push_async_callback(service.close)

    def _call(self, work: Coroutine[Any, Any, T]) -> T:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result()

    def _on_fault(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """What a callback of the loop raised: a fault of ours."""
        error = context.get("exception")
        self._failed(error if isinstance(error, Exception) else RuntimeError(context["message"]))


def _meet(one: Gateway, other: Gateway) -> bool:
    """Whether both can be open at a time is not known here, so only those are kept apart that could not."""
    if one.zenoh and other.zenoh and one.zenoh.key.value == other.zenoh.key.value:
        return True
    wanted = {where.value for where in (other.address, other.receive) if where}
    return one.name == other.name or any(where.value in wanted for where in (one.address, one.receive) if where)


def _outlets(program: Program, ros: RosEdge, feed: FeedMaker, report: Callable[[Report], None]) -> InletOutlets:
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
