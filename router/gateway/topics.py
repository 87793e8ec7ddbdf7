"""The topics that one gateway serves: which there are, and when a message of theirs becomes a frame.

Knows no clients: frames go to whoever `deliver` is.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Hashable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

from router.compiler.program import GatewayPlan
from router.compiler.selection import TopicSelector
from router.edges.gateway_transport import Frame
from router.edges.log import logger
from router.engine import Report
from router.errors import StartError
from router.gateway.documents import TopicRow
from router.gateway.encoding import LARGE, Encoding
from router.gateway.feeds import Feed, Hub, Sample
from router.gateway.following import Choice
from router.gateway.ledger import Ledger
from router.gateway.served import MOST_UNCONVERTED, Served
from router.gateway.style import UnreadableError
from router.gateway.tasks import Tasks
from router.table.model import EACH, Transport

RUN = 32
"""Topics that are served before other work of the loop has its turn."""

FIRST_LOOKS_S = (0.2, 0.5, 1.0, 2.0)
"""Pauses between looks at the graph after the start, as far as they are shorter than `discovery_period`: DDS needs a
moment to see others."""


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What all gateways of a router share. `failed` hears of faults of the router itself. Clocks in ns."""

    hub: Hub
    worker: Executor
    report: Callable[[Report], None]
    failed: Callable[[Exception], None]
    clock_ns: Callable[[], int]
    wall_ns: Callable[[], int]

    def wall_s(self) -> float:
        return self.wall_ns() * 1e-9


class Topics:
    """Everything happens in the loop's thread. `is_heard` says whether there is anybody to deliver to."""

    def __init__(
        self,
        plan: GatewayPlan,
        around: Surroundings,
        encoding: Encoding,
        ledger: Ledger,
        tasks: Tasks,
        is_heard: Callable[[], bool],
        deliver: Callable[[Sequence[Frame]], None],
    ) -> None:
        settings = plan.settings
        self._name = settings.name
        self._plan = plan
        self._around = around
        self._encoding = encoding
        self._ledger = ledger
        self._tasks = tasks
        self._is_heard = is_heard
        self._deliver = deliver
        self._selector = TopicSelector(settings, plan.inbound)
        self._served: dict[str, Served] = {}
        self._not_installed: set[str] = set()
        self._introduced: set[Hashable] = set()
        self._pending: list[Frame] = []
        # Datagrams get lost, and the existing gateway's clients expect values to be repeated.
        self._repeats = settings.transport.value is Transport.UDP
        self._most = min(settings.max_message, encoding.most)
        self._remedy = "see `max_message`" if self._most < encoding.most else "use compression or gateway_v2"

    def start(self) -> None:
        settings = self._plan.settings
        self._tasks.run(self._discover(settings.discovery_period / 1e9))
        periods = {settings.publish_period, *(rate.period for rate in settings.rates)} - {EACH}
        for period in sorted(periods):
            self._tasks.each(period / 1e9, self._tick(period))
        if settings.transport.value in (Transport.UDP, Transport.ZENOH):
            self._tasks.each(settings.schema_period / 1e9, self._repeat_schemas)

    def close(self) -> None:
        for topic in list(self._served):
            self._forget(topic)

    # -- which topics --------------------------------------------------------------------------------------------

    async def _discover(self, period_s: float) -> None:
        for pause in FIRST_LOOKS_S:
            if pause < period_s:
                await self._look()
                await asyncio.sleep(pause)
        self._tasks.each(period_s, self._look)

    async def _look(self) -> None:
        """Serves what has appeared, forgets what has gone, and follows changes of types and QoS."""
        seen = await self._around.hub.look(self._plan.inbound.keys(), self._selector.selects)
        self._not_installed &= seen.keys()
        for topic in self._served.keys() - seen.keys():
            self._forget(topic)
        for topic, choice in seen.items():
            served = self._served.get(topic)
            if served is None or served.choice != choice or not served.feed.is_open:
                self._serve(topic, choice)
                await asyncio.sleep(0)
        several = sum(bool(served.choice.others) for served in self._served.values())
        self._ledger.topics(len(self._served) - several, several, len(self._not_installed))

    def _serve(self, topic: str, choice: Choice) -> None:
        """From now on, or with another choice than before."""
        before = self._served.get(topic)
        period = self._selector.period(topic)
        each = self._on_sample if period == EACH else None
        try:
            feed = self._around.hub.join(topic, choice, each)
        except StartError as error:
            if before:
                self._forget(topic)
            if topic not in self._not_installed:
                self._not_installed.add(topic)
                logger.warning("a topic cannot be served", gateway=self._name, topic=topic, error=str(error))
            return
        self._not_installed.discard(topic)
        if before and before.feed is feed:
            self._around.hub.leave(feed, each)  # it had been joined before
            before.choice = choice
            return
        if before:
            self._forget(topic)
        self._served[topic] = Served(feed, choice, period, counted=feed.arrived, told=feed.arrived)
        if choice.others:
            logger.warning(
                "a topic has several types, and is served as that of most publishers",
                gateway=self._name,
                topic=topic,
                type=choice.type_name,
                others=list(choice.others),
            )

    def _forget(self, topic: str) -> None:
        served = self._served.pop(topic)
        came = served.came()
        self._ledger.received(came)
        if served.period == EACH:  # what came and was never handed on: the middleware's queue was full
            self._ledger.dropped("overloaded", topic, times=came)
        else:
            self._ledger.filtered(came)
        self._around.hub.leave(served.feed, self._on_sample if served.period == EACH else None)
        self._introduced.discard(self._encoding.introduces(topic, served.feed.type_name))

    # -- what becomes of their messages --------------------------------------------------------------------------

    def _tick(self, period: int) -> Callable[[], Awaitable[None]]:
        async def tick() -> None:
            frames: list[Frame] = []
            due = [served for served in self._served.values() if served.period == period]
            for number, served in enumerate(due, 1):
                self._poll(served, frames)
                if number % RUN == 0:
                    self._deliver(frames)
                    frames = []
                    await asyncio.sleep(0)
            self._deliver(frames)

        return tick

    def _poll(self, served: Served, frames: list[Frame]) -> None:
        """Adds to `frames` the topic's latest value, if it is to be sent now."""
        if served.is_busy:
            return
        came = served.came()
        self._ledger.received(came)
        if not self._is_heard():  # the middleware keeps the newest for whoever comes
            self._ledger.filtered(came)
            return
        sample = served.feed.latest() if came or served.sample is None else served.sample
        is_new = came > 0 and sample is not None and sample is not served.sample
        self._ledger.filtered(came - is_new)
        served.sample = sample
        if sample is not None and (is_new or self._repeats):
            self._offer(served, sample, frames, is_new=is_new)

    def _on_sample(self, feed: Feed, sample: Sample) -> None:
        """A message of a topic of which every one is sent."""
        served = self._served.get(feed.topic)
        if served is None:
            return
        served.counted += 1
        served.sample = sample
        self._ledger.received(1)
        if not self._is_heard():
            self._ledger.filtered(1)
        elif not served.is_busy:
            self._offer(served, sample, self._queue(), is_new=True)
        elif len(served.unconverted) < MOST_UNCONVERTED:
            served.unconverted.append(sample)
        else:
            self._ledger.dropped("overloaded", feed.topic)

    def _queue(self) -> list[Frame]:
        """Frames that go out together at the end of this turn of the loop."""
        if not self._pending:
            asyncio.get_running_loop().call_soon(self._flush)
        return self._pending

    def _flush(self) -> None:
        frames, self._pending = self._pending, []
        self._deliver(frames)

    def _offer(self, served: Served, sample: Sample, frames: list[Frame], *, is_new: bool) -> None:
        if self._is_quick(sample):
            self._encode(served, sample, frames, is_new=is_new)
        else:
            served.is_busy = True
            self._tasks.run(self._convert(served, sample, is_new=is_new))

    def _is_quick(self, sample: Sample) -> bool:
        return len(sample.cdr) <= LARGE or sample.has_payload(self._encoding.style, self._encoding.level)

    async def _convert(self, served: Served, sample: Sample, *, is_new: bool) -> None:
        """What takes long, in another thread: the topic's next value waits for it, other topics do not."""
        try:
            await asyncio.get_running_loop().run_in_executor(
                self._around.worker, sample.payload, self._encoding.style, self._encoding.level
            )
        except UnreadableError:
            pass  # and will be so again where it is counted
        finally:
            served.is_busy = False
        if self._served.get(sample.topic) is not served:
            self._ledger.filtered(is_new + len(served.unconverted))
            return
        self._encode(served, sample, self._queue(), is_new=is_new)
        while served.unconverted and not served.is_busy:
            self._offer(served, served.unconverted.popleft(), self._queue(), is_new=True)

    def _encode(self, served: Served, sample: Sample, frames: list[Frame], *, is_new: bool) -> None:
        """Adds the value, and before the first of its kind the schema."""
        try:
            data = self._frame(sample)
        except UnreadableError as error:
            if is_new:
                self._ledger.dropped("mapping_error", sample.topic, error)
            return
        if len(data.data) > self._most:
            if is_new:
                detail = f"{len(data.data)} bytes, and at most {self._most} can be sent; {self._remedy}"
                self._ledger.dropped("too_large", sample.topic, detail=detail)
            return
        if is_new:
            self._ledger.sent()
        key = self._encoding.introduces(sample.topic, sample.type_name)
        if key not in self._introduced:
            self._introduced.add(key)
            frames.append(self._schema(served))
        frames.append(data)

    def _frame(self, sample: Sample) -> Frame:
        """Raises UnreadableError."""
        data = self._encoding.data(sample, self._around.wall_s())
        return Frame(data, sample.topic, sample.type_name, is_schema=False, born=self._around.clock_ns())

    def _schema(self, served: Served) -> Frame:
        feed = served.feed
        data = self._encoding.schema(feed.topic, feed.type_name, feed.schema, self._around.wall_s())
        return Frame(data, feed.topic, feed.type_name, is_schema=True, born=self._around.clock_ns())

    async def _repeat_schemas(self) -> None:
        self._deliver([self._schema(served) for served in self._served.values() if served.sample is not None])

    # -- for who asks --------------------------------------------------------------------------------------------

    def snapshot(self, type_name: str | None = None, *, is_for_all: bool = False) -> list[Frame]:
        """Schemas and latest values of all topics, or of those of one type. `is_for_all`: everybody will have got them.

        A large value that is not converted yet comes to everybody a little later.
        """
        frames: list[Frame] = []
        for served in self._served.values():
            if type_name in (None, served.feed.type_name):
                self._show(served, frames)
        if is_for_all:
            self._introduced |= {self._encoding.introduces(frame.topic, frame.type_name) for frame in frames}
        return frames

    def _show(self, served: Served, frames: list[Frame]) -> None:
        """Leaves `served` as it is: what one client is shown, the others are still to get."""
        sample = served.feed.latest()
        if sample is None:
            return
        frames.append(self._schema(served))
        if not self._is_quick(sample):
            if not served.is_busy:
                self._offer(served, sample, frames, is_new=False)
            return
        try:
            data = self._frame(sample)
        except UnreadableError:
            return  # counted where it is new
        if len(data.data) <= self._most:
            frames.append(data)

    def rates(self, seconds: float) -> Iterator[TopicRow]:
        """Every topic, with its rate over the `seconds` since this was asked last."""
        for served in self._served.values():
            arrived = served.feed.arrived
            yield TopicRow(served.feed.topic, served.feed.type_name, (arrived - served.told) / seconds)
            served.told = arrived
