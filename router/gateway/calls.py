"""Calls of ROS services by clients. Each ends once: with a response, or with the reason why there is none."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

from router.carrier.limits import RateLimit
from router.compiler.call_counters import CallCounters, is_failure
from router.compiler.compiled_table import ANSWERED, CALL_FAILURES, ClientCallPlan, GatewayPlan
from router.compiler.metrics import Counters, Report
from router.gateway.context import Tasks
from router.gateway.documents import CallRequest, no_response_document, response_document
from router.gateway.encoding import LARGE
from router.gateway.inbound import InboundOutputs, InboundPublisher
from router.gateway.json_codec import InvalidMessageError, UnreadableError, decoder, encoder
from router.gateway.json_types import Style
from router.gateway.packets import PacketError
from router.gateway.transport.base import Client
from router.log import logger
from router.table.units import duration

if TYPE_CHECKING:  # which imports rclpy
    from concurrent.futures import Executor

    from router.ros.services import CallingClient, Response

MOST_OPEN = 64
"""Open calls of a service by all clients of a gateway: they may call faster than the server responds."""


@dataclass(eq=False, slots=True)
class _Call:
    client: Client
    id: int
    number: int
    began: int
    timer: asyncio.TimerHandle


class _Service:
    """A service that clients may call. `open` has its open calls by number, those of `ros`."""

    def __init__(self, outputs: InboundOutputs, plan: ClientCallPlan, counters: Counters) -> None:
        self.plan = plan
        self.ros: CallingClient | None = None
        self.open: dict[int, _Call] = {}
        self.timeout = plan.settings.timeout.value
        self.max_rate = plan.settings.max_rate
        self.may_pass = RateLimit(outputs.library, self.max_rate).may_pass if self.max_rate is not None else None
        self.decode, self.encode = decoder(plan.request, Style.PLAIN), encoder(plan.response, Style.PLAIN)
        self.counters = CallCounters.of(counters, plan.name)


class ClientCalls:
    """The calls of one gateway's clients.

    Use it only in the thread that owns `counts`, which is that of the event loop. `converting` converts large
    responses. `open_client` opens a client of ROS whose responses add to an eventfd.
    """

    def __init__(
        self,
        plan: GatewayPlan,
        counters: Counters,
        counts: list[int],
        outputs: InboundOutputs,
        inbound: InboundPublisher,
        converting: Executor,
        open_client: Callable[[ClientCallPlan, int], CallingClient],
    ) -> None:
        self._services = {name: _Service(outputs, call, counters) for name, call in plan.calls.items()}
        self._most = plan.settings.max_outbound
        self._counts = counts
        self._outputs = outputs
        self._inbound = inbound
        self._converting = converting
        self._open_client = open_client
        self._closing = ExitStack()

    def open(self, respond: Callable[[Client, bytes], None], tasks: Tasks) -> None:
        """Open the clients of ROS. `respond` sends a document to a client. Raises StartError."""
        if not self._services:
            return
        self._respond, self._tasks = respond, tasks
        loop = asyncio.get_running_loop()
        with ExitStack() as opening:
            self._eventfd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
            opening.callback(os.close, self._eventfd)
            for service in self._services.values():
                service.ros = self._open_client(service.plan, self._eventfd)
                opening.callback(self._close_service, service)
            loop.add_reader(self._eventfd, self._take)
            opening.callback(loop.remove_reader, self._eventfd)
            self._closing = opening.pop_all()

    def close(self) -> None:
        """End all calls, and close the clients of ROS."""
        for service in self._services.values():
            for call in list(service.open.values()):
                self._fail(service, call, "cancelled")
        self._closing.close()

    def _close_service(self, service: _Service) -> None:
        assert service.ros is not None  # noqa: S101 - opened
        service.ros.close()
        service.ros = None

    def left(self, client: Client) -> None:
        """End the calls of a client that has left."""
        for service in self._services.values():
            for call in [each for each in service.open.values() if each.client is client]:
                self._fail(service, call, "cancelled")

    def call(self, client: Client, request: CallRequest, arrived_ns: int) -> None:
        """Call a service. `arrived_ns` is wall-clock time.

        Raises RefusedError, which is counted and reported, if the request is wrong.
        """
        name = request.service
        if (service := self._services.get(name)) is None:
            raise self._inbound.refusal("not_allowed", f"clients may not call '{name[:80]}'", name)
        if request.type_name not in (None, service.plan.type_name):
            raise self._inbound.refusal("wrong_type", f"{name} has the type {service.plan.type_name}", name)
        limits = service.plan.settings
        try:
            self._inbound.check_time(name, limits, request.time)
            cdr = service.decode(request.data)
        except (InvalidMessageError, PacketError) as error:
            raise self._inbound.refusal("invalid", str(error), name) from error
        now = self._outputs.clock_ns()
        if detail := self._inbound.staleness(name, limits, request.time, arrived_ns, now):
            self._refuse(service, client, request, "refused", detail)
        elif service.may_pass and not service.may_pass(now):
            self._refuse(service, client, request, "refused", f"called more often than {service.max_rate:g} Hz")
        elif len(service.open) >= MOST_OPEN:
            self._refuse(service, client, request, "busy")
        elif service.ros is None:  # the gateway closes
            self._refuse(service, client, request, "cancelled")
        elif (number := _ask(service.ros, service.plan, cdr)) is None:
            self._refuse(service, client, request, "unsent")
        else:
            timer = asyncio.get_running_loop().call_later(service.timeout / 1e9, self._time_out, service, number)
            service.open[number] = _Call(client, request.id, number, now, timer)
            self._counts[service.counters.open] = len(service.open)

    def _take(self) -> None:
        arrived = os.eventfd_read(self._eventfd)
        for service in self._services.values():
            for response in _responses(service.ros, service.plan, arrived) if service.ros is not None else ():
                if (call := service.open.get(response.number)) is not None:  # it may have timed out
                    self._answer(service, call, response.message)

    def _answer(self, service: _Service, call: _Call, cdr: bytes) -> None:
        if len(cdr) > LARGE:
            self._tasks.run(self._convert(service, call, cdr))
        else:
            self._finish(service, call, lambda: service.encode(cdr))

    async def _convert(self, service: _Service, call: _Call, cdr: bytes) -> None:
        """Convert a response in another thread."""
        converted = asyncio.get_running_loop().run_in_executor(self._converting, service.encode, cdr)
        with suppress(UnreadableError):  # raised again when it is sent
            await converted
        if service.open.get(call.number) is call:  # it may have timed out
            self._finish(service, call, converted.result)

    def _finish(self, service: _Service, call: _Call, convert: Callable[[], bytes]) -> None:
        try:
            text = convert()
        except UnreadableError as error:
            self._fail(service, call, "refused", f"the response cannot be converted: {error}")
            return
        if len(text) > self._most:
            self._fail(service, call, "refused", f"the response has {len(text)} bytes, more than {self._most}")
            return
        self._close_call(service, call, ANSWERED)
        self._respond(call.client, response_document(call.id, text))

    def _time_out(self, service: _Service, number: int) -> None:
        self._fail(service, service.open[number], "timed_out")

    def _fail(self, service: _Service, call: _Call, outcome: str, detail: str = "") -> None:
        self._close_call(service, call, outcome, detail)
        self._respond(call.client, no_response_document(call.id, detail or _reason(service, outcome)))

    def _close_call(self, service: _Service, call: _Call, outcome: str, detail: str = "") -> None:
        call.timer.cancel()
        del service.open[call.number]
        self._counts[service.counters.open] = len(service.open)
        self._count(service, outcome, self._outputs.clock_ns() - call.began, detail)

    def _refuse(self, service: _Service, client: Client, request: CallRequest, outcome: str, detail: str = "") -> None:
        """End a call at once."""
        self._count(service, outcome, 0, detail)
        self._respond(client, no_response_document(request.id, detail or _reason(service, outcome)))

    def _count(self, service: _Service, outcome: str, took: int, detail: str) -> None:
        service.counters.count(self._counts, outcome, took)
        if is_failure(outcome):
            plan = service.plan
            self._outputs.report(Report("call", plan.name, plan.label, outcome, None, detail))


def _ask(ros: CallingClient, plan: ClientCallPlan, cdr: bytes) -> int | None:
    """Send a request to the server, and return its number; None if that is impossible."""
    try:
        return ros.ask(cdr)
    except RuntimeError as error:  # of rcl
        logger.warning("a service could not be called", service=plan.name, problem=str(error))
        return None


def _responses(ros: CallingClient, plan: ClientCallPlan, arrived: int) -> Iterator[Response]:
    try:
        yield from ros.take_all(arrived)
    except RuntimeError as error:  # of rcl
        logger.warning("responses of a service are lost", service=plan.name, problem=str(error))


def _reason(service: _Service, outcome: str) -> str:
    return CALL_FAILURES[outcome].format(service=service.plan.label, timeout=duration(service.timeout))
