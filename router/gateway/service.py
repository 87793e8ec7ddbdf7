"""One gateway: connects its topics, clients and requests. Runs in the thread of the event loop."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import AsyncExitStack
from itertools import count

from router.compiler.compiled_table import GatewayPlan
from router.gateway.calls import ClientCalls
from router.gateway.clients import Clients
from router.gateway.context import GatewayContext, Tasks
from router.gateway.counters import GatewayCounters
from router.gateway.documents import (
    CallRequest,
    inbound_document,
    no_response_document,
    rejected_document,
    topics_document,
)
from router.gateway.encoding import ENCODINGS
from router.gateway.inbound import InboundPublisher, RefusedError
from router.gateway.json_types import Style
from router.gateway.sending import TopicSender
from router.gateway.topics import Topics
from router.gateway.transport.base import Client, Frame, Transport
from router.table.model.gateways import Transport as Way

_TOPICS_S = _LOG_S = 1.0
_ANSWER_NS = 100_000_000
"""ns between two answers to schema requests: a small request has a large answer. Also between two rejections that all
in a network get.
"""


class GatewayService:
    """One gateway. Implements Events for its transport."""

    def __init__(
        self,
        plan: GatewayPlan,
        context: GatewayContext,
        counters: GatewayCounters,
        inbound: InboundPublisher,
        calls: ClientCalls,
        transport: Callable[[GatewayService], Transport],
    ) -> None:
        settings = plan.settings
        self.plan = plan
        self.is_closed = False
        self.name = settings.name
        self._context = context
        self._counters = counters
        self._inbound = inbound
        self._calls = calls
        self._responses = count()
        self._encoding = ENCODINGS[settings.format](settings)
        self._tasks = Tasks(context.failed)
        self._new_transport = transport
        self._transport = transport(self)
        self.clients = Clients(self.name, self._transport, self._encoding, counters, context.clock_ns, context.wall_s)
        sender = TopicSender(settings, context, self._encoding, counters, self._tasks, self.clients)
        self._topics = Topics(plan, context, sender, counters, self._tasks, self.clients)
        self._answered = self._explained = -_ANSWER_NS
        self._has_page = settings.transport.value is Way.WEBSOCKET and self._encoding.style is Style.PLAIN
        self._explains = self._encoding.style is Style.PLAIN
        self._is_shared = settings.transport.value is Way.ZENOH  # its one client is the network

    def replacement(self) -> GatewayService:
        """Return a new service to replace this closed one: with the same limits and counters, without clients."""
        return GatewayService(self.plan, self._context, self._counters, self._inbound, self._calls, self._new_transport)

    async def open(self) -> None:
        """Open the transport. Raises StartError if it cannot be opened."""
        self._calls.open(self._respond, self._tasks)
        try:
            await self._transport.open()
        except BaseException:
            self._calls.close()
            raise

    def start(self) -> None:
        """Start to discover and serve topics."""
        self._topics.start()
        self._tasks.every(_LOG_S, self._flush_logs)
        if self._has_page:
            self._tasks.every(_TOPICS_S, self._send_topics)

    async def close(self) -> None:
        """Stop sending and receiving. Idempotent."""
        if self.is_closed:
            return
        self.is_closed = True
        async with AsyncExitStack() as closing:  # in reverse order: clients that join or send start tasks
            closing.callback(self.clients.log.flush, final=True)
            closing.callback(self._inbound.log.flush, final=True)
            closing.callback(self._topics.log.flush, final=True)
            closing.push_async_callback(self._tasks.close)
            closing.callback(self._topics.close)
            closing.push_async_callback(self._transport.close)
            closing.push_async_callback(self._end_calls)

    async def _end_calls(self) -> None:
        self._calls.close()
        await asyncio.sleep(0)  # in this turn of the loop, clients get what has been written

    async def _flush_logs(self) -> None:
        self.clients.log.flush()
        self._inbound.log.flush()
        self._topics.log.flush()

    # -- Events --------------------------------------------------------------------------------------------------

    def joined(self, client: Client) -> None:
        queue = self.clients.joined(client)
        is_alone = len(self.clients.queues) == 1
        self.clients.send_to(queue, self._inbound_frames() + self._topics.snapshot(queue, is_for_all=is_alone))
        if is_alone:
            self._topics.discover_now()

    def left(self, client: Client) -> None:
        self.clients.left(client)
        self._calls.left(client)

    def drained(self, client: Client) -> None:
        self.clients.drained(client)

    def failed(self, client: Client | None, error: Exception, lost: int) -> None:
        self._counters.send_error(error, lost)

    def contended(self) -> None:
        self._counters.contended()

    def connected(self, number: int) -> None:
        self._counters.connected(number)

    async def snapshot(self) -> list[Frame]:
        return await self._topics.everything()

    def refused(self, reason: str) -> None:
        self._counters.arrived(0)
        self._inbound.refusal(reason)

    def received(self, client: Client, data: bytes, arrived_ns: int) -> None:
        self._counters.arrived(len(data))
        try:
            wanted = self._inbound.receive(data, arrived_ns)
        except RefusedError as refused:
            self._send_refusal(client, refused)
        else:
            if isinstance(wanted, CallRequest):
                self._call(client, wanted, arrived_ns)
            elif wanted is not None:
                self._show_schemas(client, wanted.type_name)

    # -- answers -------------------------------------------------------------------------------------------------

    def _send_refusal(self, client: Client, refused: RefusedError) -> None:
        queue = self.clients.queues.get(client)
        now = self._context.clock_ns()
        is_due = not self._is_shared or now - self._explained >= _ANSWER_NS
        if self._explains and queue is not None and is_due:
            self._explained = now
            document = rejected_document(refused.reason, str(refused), refused.topic)
            self.clients.send_to(queue, [self._document("rejected", document)])

    def _call(self, client: Client, request: CallRequest, arrived_ns: int) -> None:
        queue = self.clients.queues.get(client)
        if queue is None or not queue.keeps_up:  # responses to it wait without a limit of their own
            refused = self._inbound.refusal("rate_limited", "earlier documents must be read before a call")
            self._send_refusal(client, refused)
            return
        try:
            self._calls.call(client, request, arrived_ns)
        except RefusedError as refused:
            if self._is_shared:
                self._send_refusal(client, refused)
            else:
                self._respond(client, no_response_document(request.id, str(refused)))

    def _respond(self, client: Client, document: bytes) -> None:
        """Send a response to a call; it is lost if the client has left."""
        if (queue := self.clients.queues.get(client)) is not None:
            kind = f"response {next(self._responses)}"  # none replaces another one
            self.clients.send_to(queue, [self._document(kind, document)])

    def _show_schemas(self, client: Client, type_name: str | None) -> None:
        now = self._context.clock_ns()
        queue = self.clients.queues.get(client)
        if queue is None or now - self._answered < _ANSWER_NS:
            refused = self._inbound.refusal("rate_limited", "schemas are sent at most 10 times per second")
            self._send_refusal(client, refused)
            return
        self._answered = now
        self.clients.send_to(queue, self._topics.snapshot(queue, type_name))

    def _inbound_frames(self) -> list[Frame]:
        """Return the topics that a client may publish on, for clients with a page."""
        if not self._has_page:
            return []
        types = {inbound.label: inbound.type for inbound in self.plan.inbound.values()}
        return [self._document("inbound", inbound_document(types))]

    async def _send_topics(self) -> None:
        document = topics_document(self._context.wall_s(), self._topics.rates(_TOPICS_S))
        self.clients.send([self._document("topics", document)])

    def _document(self, kind: str, data: bytes) -> Frame:
        """Make a frame of a document without topic. For a slow client, a newer one of the same `kind` replaces it."""
        return Frame(data, kind, "", is_schema=False)
