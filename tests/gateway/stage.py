"""A gateway between topics and clients that the test plays, without ROS or network."""

from __future__ import annotations

import asyncio
import os
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, cast

from router.clock import boottime_ns, wall_ns
from router.compiler import check_table
from router.compiler.compiled_table import ClientCallPlan, CompiledTable, GatewayPlan
from router.compiler.metrics import Report
from router.errors import StartError
from router.gateway.calls import ClientCalls
from router.gateway.context import GatewayContext
from router.gateway.counters import GatewayCounters
from router.gateway.encoding import ENCODINGS
from router.gateway.inbound import InboundOutputs, InboundPublisher
from router.gateway.service import GatewayService
from router.gateway.subscriptions import Subscriptions
from router.gateway.transport.base import Client, Events, Frame
from router.library import load
from router.ros.services import CallingClient
from router.ros.topics import DiscoveredPublisher, RosTopics
from router.types.model import MessageType
from router.types.ros import ros_interfaces
from tests.tables import PROTOS

INTERFACES = ros_interfaces()
TABLE = """\
version: 1
envelope: {{protos: {protos}, message: PBEnvelope, oneof: payload}}
node: {{name: router}}
listen: {{here: {{address: 127.0.0.1:25000}}}}
endpoints: {{board: {{address: 127.0.0.2:8, kind: board}}}}
http: {{address: 127.0.0.1:9108}}
routes: {{}}
gateways: {{{gateways}}}
"""


def program(folder: Path, gateways: str) -> CompiledTable:
    """The program of a table with these gateways, a YAML flow mapping without its braces."""
    path = folder / "table.yaml"
    text = TABLE.format(protos=PROTOS, gateways=gateways)
    path.write_text(text, encoding="utf-8")
    made = check_table(path, {}).program
    assert made is not None
    return made


class Tap:
    """Stands in for a subscription."""

    def __init__(self, depth: int) -> None:
        self.fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._waiting: deque[bytes] = deque(maxlen=depth)

    def put(self, cdr: bytes) -> None:
        self._waiting.append(cdr)
        os.eventfd_write(self.fd, 1)

    def arrived(self) -> int:
        try:
            return os.eventfd_read(self.fd)
        except BlockingIOError:
            return 0

    def ask(self) -> bool:
        return False

    def take(self) -> tuple[bytes, int] | None:
        return (self._waiting.popleft(), wall_ns()) if self._waiting else None

    def close(self) -> None:
        os.close(self.fd)


class Graph:
    """A ROS graph: topics by name, each with one publisher. `faults` are errors to raise, by topic or for "names"."""

    types: Mapping[str, str] = MappingProxyType({})
    """The table's topics."""

    def __init__(self, topics: Mapping[str, str]) -> None:
        self.topics = dict(topics)
        self.faults: dict[str, Exception] = {}
        self.taps: dict[str, Tap] = {}

    def resolved(self, name: str) -> str:
        return name

    def names(self) -> list[str]:
        if fault := self.faults.pop("names", None):
            raise fault
        return [*self.topics]

    def publishers(self, topic: str) -> list[DiscoveredPublisher]:
        return [DiscoveredPublisher(self.topics[topic], is_reliable=True, keeps=False, is_ours=False, gid=b"one")]

    def has_publishers(self, topic: str) -> bool:
        return topic in self.topics

    def installed_type(self, type_name: str) -> MessageType:
        raise StartError(f"{type_name} is not installed")

    def load(self, type_name: str, definitions: object) -> object:
        return type_name

    def tap(self, topic: str, message_class: object, *, is_reliable: bool, keeps: bool, depth: int) -> Tap:
        if fault := self.faults.get(topic):
            raise fault
        self.taps[topic] = Tap(depth)
        return self.taps[topic]


class PlayedClient:
    def __init__(self) -> None:
        self.label = "a test"
        self.frames: list[Frame] = []

    def write(self, frames: Sequence[Frame]) -> None:
        self.frames += frames

    def backlog(self) -> int:
        return 0

    def close(self) -> None:
        """Nothing to close."""

    @property
    def values(self) -> list[Frame]:
        return [frame for frame in self.frames if frame.topic.startswith("/") and not frame.is_schema]


class PlayedTransport:
    """A transport with one client from the start. The client sends `last_words` while the gateway closes."""

    def __init__(self, events: Events) -> None:
        self.client = PlayedClient()
        self.last_words: list[bytes] = []
        self._ears = events

    async def open(self) -> None:
        self._ears.joined(self.client)

    async def close(self) -> None:
        await asyncio.sleep(0)
        for data in self.last_words:
            self._ears.received(self.client, data, wall_ns())
        self._ears.left(self.client)

    def write_all(self, clients: Iterable[Client], frames: Sequence[Frame]) -> None:
        for client in clients:
            client.write(frames)


class Stage:
    """The gateways of a program, as one `Played` each, with shared topics: `async with Stage(program, graph)`."""

    def __init__(self, made: CompiledTable, graph: Graph | RosTopics) -> None:
        self.faults: list[Exception] = []
        self.reports: list[Report] = []
        self.published: list[tuple[str, bytes]] = []
        self.counts = made.counters.fresh_counts()
        self._counters = made.counters
        self._graph = graph
        self._plans = made.gateways
        self._closing = ExitStack()

    async def __aenter__(self) -> Stage:
        worker = self._closing.enter_context(ThreadPoolExecutor(1))
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(lambda _, context: self.faults.append(context["exception"]))
        subscriptions = Subscriptions(cast("RosTopics", self._graph), INTERFACES, loop)
        self._closing.callback(subscriptions.close)
        self.context = GatewayContext(subscriptions, worker, self.faults.append, lambda: None, boottime_ns, wall_ns)
        self.played = {plan.settings.name: Played(self, plan) for plan in self._plans}
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for played in self.played.values():
            await played.close()
        self._closing.close()

    def count(self, metric: str, *labels: str) -> int:
        return self.counts[self._counters.index(metric, *labels)]

    def gateway_counters(self, plan: GatewayPlan) -> GatewayCounters:
        return GatewayCounters(plan.settings, self._counters, self.counts, self.reports.append, boottime_ns)

    def inbound(self, plan: GatewayPlan) -> InboundPublisher:
        encoding = ENCODINGS[plan.settings.format](plan.settings)
        return InboundPublisher(plan, encoding, self._counters, self.counts, self._outputs(plan))

    def calls(self, plan: GatewayPlan, inbound: InboundPublisher) -> ClientCalls:
        def refuse(call: ClientCallPlan, _: int) -> CallingClient:
            raise AssertionError(f"{call.label} needs ROS")

        outputs, converting = self._outputs(plan), self.context.converting
        return ClientCalls(plan, self._counters, self.counts, outputs, inbound, converting, refuse)

    def _outputs(self, plan: GatewayPlan) -> InboundOutputs:
        def publisher(topic: str) -> Any:
            return lambda cdr: self.published.append((topic, cdr))

        return InboundOutputs(
            library=load(),
            publish={topic: publisher(topic) for topic in plan.inbound},
            publish_errors=(),
            feed_deadman={},
            report=self.reports.append,
            clock_ns=boottime_ns,
            wall_ns=wall_ns,
        )


class Played:
    """One gateway and its client."""

    def __init__(self, stage: Stage, plan: GatewayPlan) -> None:
        counters, inbound = stage.gateway_counters(plan), stage.inbound(plan)
        self.service = GatewayService(
            plan, stage.context, counters, inbound, stage.calls(plan, inbound), self._transport
        )
        self._is_open = False

    def _transport(self, events: Events) -> PlayedTransport:
        self.transport = PlayedTransport(events)
        return self.transport

    @property
    def client(self) -> PlayedClient:
        return self.transport.client

    async def start(self) -> None:
        await self.service.open()
        self.service.start()
        self._is_open = True

    async def close(self) -> None:
        if self._is_open:
            self._is_open = False
            await self.service.close()
