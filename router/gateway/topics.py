"""The topics that one gateway serves: which there are, and when their latest values are due.

What becomes of their messages is `outlet`'s.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator, Sequence

from router.compiler.program import GatewayPlan
from router.compiler.selection import TopicSelector
from router.edges.gateway_transport import Frame
from router.edges.log import logger
from router.errors import StartError
from router.gateway.documents import TopicRow
from router.gateway.feeds import Feed
from router.gateway.following import Choice
from router.gateway.ledger import Ledger
from router.gateway.outlet import Outlet
from router.gateway.samples import Sample
from router.gateway.served import Served
from router.gateway.surroundings import Surroundings
from router.gateway.tasks import Tasks
from router.table.model import EACH, Transport

RUN = 32
"""Topics that are served before other work of the loop has its turn."""

FIRST_LOOKS_S = (0.2, 0.5, 1.0, 2.0)
"""Pauses between looks at the graph after the start, as far as they are shorter than `discovery_period`: DDS needs a
moment to see others."""


class Topics:
    """Everything happens in the loop's thread. A fault with one topic is told, and keeps no other from its turn."""

    def __init__(
        self,
        plan: GatewayPlan,
        around: Surroundings,
        outlet: Outlet,
        ledger: Ledger,
        tasks: Tasks,
        deliver: Callable[[Sequence[Frame]], None],
    ) -> None:
        self._name = plan.settings.name
        self._plan = plan
        self._hub = around.hub
        self._failed = around.failed
        self._outlet = outlet
        self._ledger = ledger
        self._tasks = tasks
        self._deliver = deliver
        self._selector = TopicSelector(plan.settings, plan.inbound)
        self._served: dict[str, Served] = {}
        self._not_installed: set[str] = set()

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
                await self._tasks.attempt(self._look)
                await asyncio.sleep(pause)
        self._tasks.each(period_s, self._look)

    async def _look(self) -> None:
        """Serves what has appeared, forgets what has gone, and follows changes of types and QoS."""
        seen = await self._hub.look(self._plan.inbound.keys(), self._selector.selects)
        self._not_installed &= seen.keys()
        for topic in self._served.keys() - seen.keys():
            self._forget(topic)
        for topic, choice in seen.items():
            served = self._served.get(topic)
            if served is None or served.choice != choice or not served.feed.is_open:
                self._try_to_serve(topic, choice)
                await asyncio.sleep(0)
            elif served.period == EACH:
                self._outlet.settle(served)
        several = sum(bool(served.choice.others) for served in self._served.values())
        self._ledger.topics(len(self._served) - several, several, len(self._not_installed))

    def _try_to_serve(self, topic: str, choice: Choice) -> None:
        try:
            self._serve(topic, choice)
        except StartError as error:
            if topic in self._served:
                self._forget(topic)
            if topic not in self._not_installed:
                self._not_installed.add(topic)
                logger.warning("a topic cannot be served", gateway=self._name, topic=topic, error=str(error))
        except Exception as error:  # noqa: BLE001 told loudly; other topics are served all the same
            self._failed(error)

    def _serve(self, topic: str, choice: Choice) -> None:
        """From now on, or with another choice than before. Raises StartError."""
        before = self._served.get(topic)
        period = self._selector.period(topic)
        each = self._on_sample if period == EACH else None
        feed = self._hub.join(topic, choice, each)
        self._not_installed.discard(topic)
        if before and before.feed is feed:
            self._hub.leave(feed, each)  # it had been joined before
            before.choice = choice
            return
        if before:
            self._forget(topic)
        self._served[topic] = Served.fresh(feed, choice, period)
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
        self._outlet.end(served)
        self._hub.leave(served.feed, self._on_sample if served.period == EACH else None)

    # -- when they are served ------------------------------------------------------------------------------------

    def _tick(self, period: int) -> Callable[[], Awaitable[None]]:
        async def tick() -> None:
            frames: list[Frame] = []
            due = [served for served in self._served.values() if served.period == period]
            for number, served in enumerate(due, 1):
                try:
                    self._outlet.poll(served, frames)
                except Exception as error:  # noqa: BLE001 told loudly; other topics are served all the same
                    self._failed(error)
                if number % RUN == 0:
                    self._deliver(frames)
                    frames = []
                    await asyncio.sleep(0)
            self._deliver(frames)

        return tick

    def _on_sample(self, feed: Feed, sample: Sample) -> None:
        if (served := self._served.get(feed.topic)) and served.feed is feed:
            self._outlet.take(served, sample)

    async def _repeat_schemas(self) -> None:
        known = [served for served in self._served.values() if served.sample is not None]
        self._deliver([self._outlet.schema(served) for served in known])

    # -- for who asks --------------------------------------------------------------------------------------------

    def snapshot(self, type_name: str | None = None, *, is_for_all: bool = False) -> list[Frame]:
        """Schemas and latest values of all topics, or of those of one type. `is_for_all`: everybody will have got them.

        A large value that is not converted yet comes to everybody a little later.
        """
        frames: list[Frame] = []
        for served in self._served.values():
            if type_name in (None, served.feed.type_name):
                self._outlet.show(served, frames)
        if is_for_all:
            self._outlet.introduced(frames)
        return frames

    def rates(self, seconds: float) -> Iterator[TopicRow]:
        """Every topic, with its rate over the `seconds` since this was asked last."""
        for served in self._served.values():
            arrived = served.feed.arrived
            yield TopicRow(served.feed.topic, served.feed.type_name, (arrived - served.told) / seconds)
            served.told = arrived
