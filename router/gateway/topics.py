"""The topics that one gateway serves: which there are, and when their latest values are due.

What becomes of their messages is `outlet`'s.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from itertools import chain, count, repeat

from router.compiler.program import GatewayPlan
from router.compiler.selection import TopicSelector
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
from router.gateway.transport.base import Frame
from router.log import logger
from router.table.model import EACH, GatewayFormat, Transport

RUN = 32
"""Topics that are served before other work of the loop has its turn."""

MOST_TURNS = 20
"""Into so many turns a period is divided where each packet is a datagram: receivers with the kernel's default buffer
lose some of a burst of two hundred."""

SHORTEST_PAUSE_S = 0.1
"""Between looks, however many clients come."""

SHORTEST_TURN = 10_000_000
"""ns between turns, at least: more often costs more than it spreads."""

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
        self._let_in = around.hub.resolved(each.topic for each in plan.inbound.values())
        self._selector = TopicSelector(plan.settings, self._let_in)
        self._served: dict[str, Served] = {}
        self._not_installed: set[str] = set()
        self._numbers = count()
        self._wanted = asyncio.Event()
        self._spreads = plan.settings.format is GatewayFormat.GATEWAY_V1 and (
            plan.settings.transport.value is Transport.UDP
        )

    def start(self) -> None:
        settings = self._plan.settings
        self._tasks.run(self._discover(settings.discovery_period / 1e9))
        periods = {settings.publish_period, *(rate.period for rate in settings.rates)} - {EACH}
        for period in sorted(periods):
            self._in_turns(period, partial(self._publish, period))
        if settings.transport.value in (Transport.UDP, Transport.ZENOH):
            self._in_turns(settings.schema_period, self._repeat_schemas)

    def close(self) -> None:
        for topic in list(self._served):
            self._forget(topic)

    # -- which topics --------------------------------------------------------------------------------------------

    def look_again(self) -> None:
        """Somebody has come, and wants topics for which nobody was there."""
        self._wanted.set()

    async def _discover(self, period_s: float) -> None:
        first = (pause for pause in FIRST_LOOKS_S if pause < period_s)
        for pause in chain(first, repeat(period_s)):
            self._wanted.clear()
            await self._tasks.attempt(self._look)
            await asyncio.sleep(at_least := min(pause, SHORTEST_PAUSE_S))
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._wanted.wait(), pause - at_least)

    async def _look(self) -> None:
        """Serves what has appeared, forgets what has gone, and follows changes of types and QoS."""
        seen = await self._hub.look(self._let_in, self._selector.selects)
        if not self._outlet.is_heard():
            # What only the router publishes it fills only while somebody listens, and without clients nobody does.
            seen = {topic: choice for topic, choice in seen.items() if not choice.is_ours}
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
        served = self._served[topic] = Served.fresh(feed, choice, period, next(self._numbers))
        if each and choice.keeps and (kept := feed.latest()):
            self._outlet.take(served, kept)  # publishers do not send it again to a feed that is there already
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

    def _in_turns(self, period: int, serve: Callable[[Sequence[Served]], Awaitable[None]]) -> None:
        """Has each topic served once in a `period` of ns, one after the other or all at once."""
        number = max(1, min(MOST_TURNS, period // SHORTEST_TURN)) if self._spreads else 1
        turn_s = period / number / 1e9
        clock = asyncio.get_running_loop().time
        begin, done = clock(), -1

        async def turn() -> None:
            """Those whose turn was missed have it now as well."""
            nonlocal done
            now = round((clock() - begin) / turn_s)
            turns = {each % number for each in range(max(done, now - number) + 1, now + 1)}
            done = now
            await serve([served for served in self._served.values() if served.number % number in turns])

        self._tasks.each(turn_s, turn)

    async def _publish(self, period: int, due: Sequence[Served]) -> None:
        frames: list[Frame] = []
        for number, served in enumerate([each for each in due if each.period == period], 1):
            try:
                self._outlet.poll(served, frames)
            except Exception as error:  # noqa: BLE001 told loudly; other topics are served all the same
                self._failed(error)
            if number % RUN == 0:
                self._deliver(frames)
                frames = []
                await asyncio.sleep(0)
        self._deliver(frames)

    def _on_sample(self, feed: Feed, sample: Sample) -> None:
        if (served := self._served.get(feed.topic)) and served.feed is feed:
            self._outlet.take(served, sample)

    async def _repeat_schemas(self, due: Sequence[Served]) -> None:
        self._deliver([self._outlet.schema(served) for served in due if served.readable is not None])

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
