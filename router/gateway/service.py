"""One gateway: its topics, its clients, and what they send, brought together. Runs in the thread of an event loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AsyncExitStack

from router.compiler.program import GatewayPlan
from router.gateway.documents import (
    InboundRow,
    SchemaRequest,
    inbound_document,
    rejected_document,
    topics_document,
)
from router.gateway.encoding import ENCODINGS
from router.gateway.inlet import Checked, Inlet, RefusedError
from router.gateway.json_reading import example
from router.gateway.ledger import Ledger
from router.gateway.outlet import Outlet
from router.gateway.reader import Reader, Understood
from router.gateway.schema_text import schema_text
from router.gateway.style import Style
from router.gateway.subscribers import Subscribers
from router.gateway.surroundings import Surroundings
from router.gateway.tasks import Tasks
from router.gateway.topics import Topics
from router.gateway.transport.base import Client, Frame, Transport
from router.table.model import Transport as Way

_TELL_S = _LOG_S = 1.0
_ANSWER_NS = 100_000_000
"""How often schemas are sent because a client asks for them: a small question has a large answer."""


class GatewayService:
    """Implements Events, for its transport."""

    def __init__(
        self,
        plan: GatewayPlan,
        around: Surroundings,
        ledger: Ledger,
        inlet: Inlet,
        transport: Callable[[GatewayService], Transport],
    ) -> None:
        settings = plan.settings
        self.plan = plan
        self.is_closed = False
        self.name = settings.name
        self._around = around
        self._ledger = ledger
        self._inlet = inlet
        self._encoding = ENCODINGS[settings.format](settings)
        self._tasks = Tasks(around.failed)
        self.subscribers = Subscribers(self.name, self._encoding, ledger, around.clock_ns, around.wall_s)
        outlet = Outlet(
            settings, around, self._encoding, ledger, self._tasks, lambda: bool(self.subscribers), self._deliver
        )
        self._topics = Topics(plan, around, outlet, ledger, self._tasks, self._deliver)
        self._new_transport = transport
        self._transport = transport(self)
        self._answered = -_ANSWER_NS
        self._reader = Reader(self._encoding, inlet, self._tasks, around.reading, self._settle)
        self._has_page = settings.transport.value is Way.WEBSOCKET and self._encoding.style is Style.PLAIN
        self._explains = settings.transport.value is not Way.ZENOH and self._encoding.style is Style.PLAIN

    def anew(self) -> GatewayService:
        """One like this, which was closed: with the same limits and counters, without its clients."""
        return GatewayService(self.plan, self._around, self._ledger, self._inlet, self._new_transport)

    async def open(self) -> None:
        """Raises StartError."""
        await self._transport.open()

    def start(self) -> None:
        """Looks for topics and serves them from now on."""
        self._topics.start()
        self._tasks.each(_LOG_S, self.subscribers.flush_log)
        if self._has_page:
            self._tasks.each(_TELL_S, self._tell_topics)

    async def close(self) -> None:
        """Nothing is sent or received any more; closing again changes nothing."""
        if self.is_closed:
            return
        self.is_closed = True
        async with AsyncExitStack() as closing:  # in the opposite order: who comes or sends something begins tasks
            closing.callback(self.subscribers.close)
            closing.push_async_callback(self._tasks.close)
            closing.callback(self._topics.close)
            closing.push_async_callback(self._transport.close)

    def _deliver(self, frames: Sequence[Frame]) -> None:
        self.subscribers.send(frames, self._transport)

    # -- Events --------------------------------------------------------------------------------------------------

    def joined(self, client: Client) -> None:
        subscriber = self.subscribers.joined(client)
        is_alone = len(self.subscribers.by_client) == 1
        self.subscribers.send_to(subscriber, self._hello() + self._topics.snapshot(is_for_all=is_alone))
        if is_alone:
            self._topics.look_again()

    def left(self, client: Client) -> None:
        self.subscribers.left(client)

    def drained(self, client: Client) -> None:
        self.subscribers.drained(client)

    def failed(self, client: Client | None, error: Exception, lost: int) -> None:
        self._ledger.send_error(error, lost)

    def contended(self) -> None:
        self._ledger.contended()

    def snapshot(self) -> list[Frame]:
        return self._topics.snapshot()

    def refused(self, reason: str) -> None:
        self._ledger.arrived(0)
        self._inlet.reject(reason)

    def received(self, client: Client, data: bytes, arrived_ns: int) -> None:
        self._ledger.arrived(len(data))
        self._reader.received(client, data, arrived_ns)

    def _settle(self, client: Client, understood: Understood, arrived_ns: int) -> None:
        match understood:
            case RefusedError():
                self._refuse(client, understood)
            case SchemaRequest():
                self._show_schemas(client, understood.type_name)
            case Checked():
                try:
                    self._inlet.publish(understood, arrived_ns)
                except RefusedError as refused:
                    self._tell(client, refused)

    # -- answers -------------------------------------------------------------------------------------------------

    def _refuse(self, client: Client, refused: RefusedError) -> None:
        self._inlet.reject(refused.reason, str(refused))
        self._tell(client, refused)

    def _tell(self, client: Client, refused: RefusedError) -> None:
        subscriber = self.subscribers.by_client.get(client)
        if self._explains and subscriber is not None:
            document = rejected_document(refused.reason, str(refused), refused.topic)
            self.subscribers.send_to(subscriber, [self._document("rejected", document)])

    def _show_schemas(self, client: Client, type_name: str | None) -> None:
        now = self._around.clock_ns()
        subscriber = self.subscribers.by_client.get(client)
        if subscriber is None or now - self._answered < _ANSWER_NS:
            self._refuse(client, RefusedError("rate_limited", "schemas are sent 10 times per second at most"))
            return
        self._answered = now
        self.subscribers.send_to(subscriber, self._topics.snapshot(type_name))

    def _hello(self) -> list[Frame]:
        """What a client may send, for one that can show that to a person."""
        if not self._has_page:
            return []
        rows = [
            InboundRow(inbound.label, inbound.type.name, schema_text(inbound.type), example(inbound.type))
            for inbound in self.plan.inbound.values()
        ]
        return [self._document("inbound", inbound_document(rows))]

    async def _tell_topics(self) -> None:
        rows = list(self._topics.rates(_TELL_S))
        self._deliver([self._document("topics", topics_document(self._around.wall_s(), rows))])

    def _document(self, kind: str, data: bytes) -> Frame:
        """One that belongs to no topic; with a slow client, a newer one of its kind takes its place."""
        return Frame(data, kind, "", is_schema=False)
