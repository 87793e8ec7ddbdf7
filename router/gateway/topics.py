"""The topics that one gateway serves: discovers them, and sends their latest values when due."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Iterator, Sequence
from contextlib import aclosing, suppress
from functools import partial
from itertools import chain, count, repeat
from math import inf

from router.compiler.compiled_table import GatewayPlan
from router.compiler.selection import TopicSelector
from router.errors import StartError
from router.gateway.clients import ClientQueue, Clients
from router.gateway.context import GatewayContext, Tasks
from router.gateway.counters import GatewayCounters
from router.gateway.encoding import Sample
from router.gateway.latched import Fetched
from router.gateway.publishers import Selection
from router.gateway.sending import ServedTopic, TopicSender
from router.gateway.subscriptions import NotInstalledError, TopicSubscription
from router.gateway.transport.base import LOW_WATER, PER_TURN, Frame
from router.log import FloodLog, logger
from router.table.model.gateways import EACH, GatewayFormat, Transport

MOST_TURNS = 20
"""Maximum parts of a period over which topics are spread if each packet is a datagram: receivers with the kernel's
default buffer lose some of a burst of two hundred.
"""

SHORTEST_PAUSE_S = 0.1
"""The minimum time between two discoveries, even if many clients join."""

RESEND_S = 0.5
"""The interval of checks for clients that lack messages which publishers still keep."""

DRAIN_S, SHOW_S = 1.0, 10.0
"""How long latched messages of a topic wait for a client that takes nothing, and for one that takes them slowly."""

SHORTEST_TURN = 10_000_000
"""The minimum time between turns, ns: shorter ones cost more than they gain."""

PUBLISHED_S = 0.002
"""How long to wait for messages that the router publishes when its gateways ask; later ones are sent a turn later."""

MOST_NAMED = 5
"""Maximum topics that a line of the log names."""

FIRST_PAUSES_S = (0.2, 0.5, 1.0, 2.0)
"""Times between the first discoveries, if shorter than `discovery_period`: DDS takes a moment to find others."""


class Topics:
    """The topics of one gateway. Runs in the loop's thread. A fault in one topic is reported and affects no other.

    Flush `log` regularly.
    """

    def __init__(
        self,
        plan: GatewayPlan,
        context: GatewayContext,
        sender: TopicSender,
        counters: GatewayCounters,
        tasks: Tasks,
        clients: Clients,
    ) -> None:
        self._name = plan.settings.name
        self._plan = plan
        self._subscriptions = context.subscriptions
        self._publish_newest = context.publish_newest
        self._failed = context.failed
        self._sender = sender
        self._counters = counters
        self._tasks = tasks
        self._clients = clients
        self._inbound = context.subscriptions.resolved(
            inbound.settings.topic.topic.value for inbound in plan.inbound.values()
        )
        self._selector = TopicSelector(plan.settings, self._inbound)
        self._served: dict[str, ServedTopic] = {}
        self._not_served: dict[str, str] = {}  # by topic: its state
        self._over_limit: set[str] = set()
        self.log = FloodLog()
        self._numbers = count()
        self._discover_now = asyncio.Event()
        self._is_udp = plan.settings.transport.value is Transport.UDP
        self._is_shared = plan.settings.transport.value is Transport.ZENOH  # its one client is the network
        self._is_spread = self._is_udp and plan.settings.format is GatewayFormat.GATEWAY_V1

    def start(self) -> None:
        settings = self._plan.settings
        self._tasks.run(self._discover(settings.discovery_period / 1e9))
        periods = {settings.publish_period, *(rate.period for rate in settings.rates)} - {EACH}
        for period in sorted(periods):
            self._schedule(period, partial(self._publish, period))
        if settings.transport.value in (Transport.UDP, Transport.ZENOH):
            self._schedule(settings.schema_period, self._repeat_schemas)
        self._tasks.every(RESEND_S, self._resend_missed)

    def close(self) -> None:
        for topic in list(self._served):
            self._forget(topic)

    # -- which topics --------------------------------------------------------------------------------------------

    def discover_now(self) -> None:
        """Discover again now: some topics are served only while there are clients."""
        self._discover_now.set()

    async def _discover(self, period_s: float) -> None:
        first = (pause for pause in FIRST_PAUSES_S if pause < period_s)
        for pause in chain(first, repeat(period_s)):
            self._discover_now.clear()
            await self._tasks.attempt(self._update)
            await asyncio.sleep(at_least := min(pause, SHORTEST_PAUSE_S))
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._discover_now.wait(), pause - at_least)

    async def _update(self) -> None:
        """Serve new topics, forget those that are gone, and follow changes of types and QoS."""
        most = self._plan.settings.max_topics
        selections, over_limit = await self._subscriptions.discover(self._inbound, self._rank, most)
        if not self._clients:
            # While a topic has subscribers, the router publishes on it: do not subscribe without clients.
            selections = {topic: selection for topic, selection in selections.items() if not selection.is_ours}
        self._not_served = {topic: state for topic, state in self._not_served.items() if topic in selections}
        for topic in self._served.keys() - selections.keys():
            self._forget(topic)
        for topic, selection in selections.items():
            served = self._served.get(topic)
            if served is None or served.selection != selection or not served.subscription.is_open:
                self._try_to_serve(topic, selection)
                await asyncio.sleep(0)
            elif served.period == EACH:
                self._sender.count_missed(served)
        served_as = ("several_types" if served.selection.others else "served" for served in self._served.values())
        states = Counter(chain(served_as, self._not_served.values()))
        self._counters.topics({**states, "over_limit": len(over_limit)})
        self._log_over_limit(over_limit)

    def _rank(self, topic: str) -> int | None:
        """Return which topics come first if there are more than `max_topics`; None for those that are not wanted."""
        if not self._selector.selects(topic):
            return None
        if self._selector.names(topic) or self._subscriptions.is_of_table(topic):
            return 0
        return 1 if topic in self._served else 2

    def _log_over_limit(self, topics: set[str]) -> None:
        """Log which topics are not served because of `max_topics`, if there are new ones."""
        if new := topics - self._over_limit:
            self.log.note(
                "over_limit",
                logger.warning,
                "too many topics; name those that you need in `include`, or raise `max_topics`",
                gateway=self._name,
                max_topics=self._plan.settings.max_topics,
                not_served=len(topics),
                such_as=sorted(new)[:MOST_NAMED],
            )
        self._over_limit = topics

    def _try_to_serve(self, topic: str, selection: Selection) -> None:
        try:
            self._serve(topic, selection)
        except StartError as error:
            if topic in self._served:
                self._forget(topic)
            state = "not_installed" if isinstance(error, NotInstalledError) else "refused"
            if self._not_served.get(topic) != state:
                self._not_served[topic] = state
                logger.warning("topic cannot be served", gateway=self._name, topic=topic, error=str(error))
        except Exception as error:  # noqa: BLE001 reported; other topics are still served
            self._failed(error)

    def _serve(self, topic: str, selection: Selection) -> None:
        """Serve a topic from now on, or with a new selection. Raises StartError."""
        before = self._served.get(topic)
        period = self._selector.period(topic)
        callback = self._on_sample if period == EACH else None
        is_new = not self._subscriptions.is_joined(topic, callback)
        subscription = self._subscriptions.join(topic, selection, callback)
        self._not_served.pop(topic, None)
        if before and before.subscription is subscription:
            self._subscriptions.leave(subscription, callback)  # it was already joined
            if selection.is_mixed and selection.keepers - before.selection.keepers:
                self._clients.record_miss(topic)  # this subscription does not get their latched messages
            if before.selection.keepers - selection.keepers:
                before.readable = None  # its publisher may be gone
            before.selection = selection
            return
        if before:
            self._forget(topic)
        served = ServedTopic.begin(subscription, selection, period, next(self._numbers))
        self._served[topic] = served
        if self._clients and selection.keepers and not (callback and is_new and selection.keeps):
            self._introduce(served)
        if selection.others:
            logger.warning(
                "the topic has several types; serving one of them",
                gateway=self._name,
                topic=topic,
                type=selection.type_name,
                others=list(selection.others),
            )

    def _forget(self, topic: str) -> None:
        served = self._served.pop(topic)
        self._sender.end(served)
        self._subscriptions.leave(served.subscription, self._on_sample if served.period == EACH else None)

    # -- when they are served ------------------------------------------------------------------------------------

    def _schedule(self, period: int, serve: Callable[[Sequence[ServedTopic]], Awaitable[None]]) -> None:
        """Serve each topic once in a `period` (ns), spread over the period or all at once."""
        number = max(1, min(MOST_TURNS, period // SHORTEST_TURN)) if self._is_spread else 1
        turn_s = period / number / 1e9
        clock = asyncio.get_running_loop().time
        begin, done = clock(), -1

        async def turn() -> None:
            """Serve the topics whose turn is now or was missed."""
            nonlocal done
            now = round((clock() - begin) / turn_s)
            turns = {slot % number for slot in range(max(done, now - number) + 1, now + 1)}
            done = now
            await serve([served for served in self._served.values() if served.number % number in turns])

        self._tasks.every(turn_s, turn)

    async def _publish(self, period: int, due: Sequence[ServedTopic]) -> None:
        frames: list[Frame] = []
        due = [served for served in due if served.period == period]
        asked = [served for served in due if self._clients and served.subscription.ask()]
        if asked:
            self._publish_newest()
            await asyncio.sleep(min(PUBLISHED_S, period / 4e9))
        for number, served in enumerate(due, 1):
            try:
                self._sender.poll(served, frames)
            except Exception as error:  # noqa: BLE001 reported; other topics are still served
                self._failed(error)
            if number % PER_TURN == 0:
                self._clients.send(frames)
                frames = []
                await asyncio.sleep(0)
        self._clients.send(frames)

    def _on_sample(self, subscription: TopicSubscription, sample: Sample) -> None:
        if (served := self._served.get(subscription.topic)) and served.subscription is subscription:
            self._sender.send(served, sample)

    async def _repeat_schemas(self, due: Sequence[ServedTopic]) -> None:
        is_known = [served for served in due if served.readable is not None or served.selection.keepers]
        self._clients.send([self._sender.schema(served) for served in is_known])
        if self._is_udp:  # a new client goes unnoticed
            for queue in self._clients.queues.values():
                self._show_latched(queue, is_known, may_hold=False)

    # -- latched messages ----------------------------------------------------------------------------------------------

    def _show_latched(self, queue: ClientQueue, topics: Iterable[ServedTopic], *, may_hold: bool = True) -> None:
        """Send a client the latched messages of these topics, a little later.

        Newer messages are held until then, if they may be and all publishers of their topic keep messages.
        """
        for served in topics:
            topic = served.subscription.topic
            holds = served.selection.keeps and may_hold
            if served.selection.keepers and (not holds or queue.hold(topic)):
                self._tasks.run(self._show(queue, topic, holds=holds))

    async def _show(self, queue: ClientQueue, topic: str, *, holds: bool) -> None:
        queue.missed_topics.discard(topic)
        is_whole, is_complete = await self._write_latched(queue, topic)
        known = queue.shown.get(topic, set()) if not is_whole else queue.shown.pop(topic, set())
        held = queue.release(topic, is_complete=is_complete) if holds else []
        if queue.has_left:
            return
        if not is_whole:
            queue.missed_topics.add(topic)
        missing = [frame for frame in held if frame.sent_ns not in known]
        self._clients.send_to(queue, sorted(missing, key=lambda frame: frame.sent_ns))

    async def _write_latched(self, queue: ClientQueue, topic: str) -> tuple[bool, bool]:
        """Write the latched messages of a topic as the client drains, without those that it has.

        Return whether it has all of them, and whether no other message has arrived since.
        """
        is_whole = is_complete = True
        while (served := self._served.get(topic)) is not None and served.selection.keepers and not queue.has_left:
            try:
                async with served.subscription.latched.fetched() as fetched:
                    is_whole = await self._write_fetched(queue, served, fetched)
                    is_complete = fetched.arrived == served.subscription.arrived
            except Exception as error:  # noqa: BLE001 reported; other messages are still sent
                self._failed(error)
                break
            if not served.has_ended:
                return is_whole, is_complete
        return True, False

    async def _write_fetched(self, queue: ClientQueue, served: ServedTopic, fetched: Fetched) -> bool:
        """Write fetched messages as the client drains. Return False if it takes nothing for DRAIN_S, or too long.

        Then it gets the others later, from publishers that still keep them.
        """
        topic = served.subscription.topic
        known = queue.shown.setdefault(topic, set())
        skipped = {
            *known,
            *(sample.sent_ns for sample in fetched.samples),
        }  # held ones that come, or came, from publishers
        begun_with = frozenset(known)
        until = asyncio.get_running_loop().time() + SHOW_S
        waiting: list[Frame] = []
        async with aclosing(self._sender.latched(served, fetched)) as frames:
            async for frame in frames:
                if queue.has_left:
                    return False
                if frame.sent_ns in begun_with:
                    continue
                if waiting and sum(len(other.data) for other in (*waiting, frame)) > LOW_WATER:
                    if not await self._write_when_drained(queue, waiting, until):
                        return False
                    known.update(other.sent_ns for other in waiting)
                    waiting = []
                held = [other for other in queue.held_before(topic, frame.sent_ns) if other.sent_ns not in skipped]
                skipped.update(other.sent_ns for other in held)
                waiting += (*held, frame)
        while waiting := waiting or _beginning(
            other for other in queue.held_before(topic, inf) if other.sent_ns not in known
        ):
            if not await self._write_when_drained(queue, waiting, until):
                return False
            known.update(other.sent_ns for other in waiting)
            waiting = []
        return True

    async def _write_when_drained(self, queue: ClientQueue, frames: Sequence[Frame], until: float) -> bool:
        if not await queue.takes_more(DRAIN_S, until):
            return False
        if not self._clients.has_room(sum(len(frame.data) for frame in frames)):
            return False
        queue.write(frames)
        return True

    def _introduce(self, served: ServedTopic) -> None:
        """Begin to serve a topic while there are clients."""
        schema = self._sender.schema(served)
        self._clients.send([schema])
        self._sender.introduced([schema])
        for queue in self._clients.queues.values():
            self._show_latched(queue, [served])

    async def _resend_missed(self) -> None:
        """Send clients the messages of a topic that they lack, once it is quiet and they keep up."""
        behind = [queue for queue in self._clients.queues.values() if queue.missed_topics and queue.keeps_up]
        for topic in {topic for queue in behind for topic in queue.missed_topics}:
            served = self._served.get(topic)
            if served and served.selection.keepers and not served.is_quiet():
                continue
            for queue in behind:
                if topic in queue.missed_topics and not queue.is_held(topic):
                    queue.missed_topics.discard(topic)
                    self._show_latched(queue, [served] if served else [])

    # -- answers -----------------------------------------------------------------------------------------------

    def snapshot(self, queue: ClientQueue, type_name: str | None = None, *, is_for_all: bool = False) -> list[Frame]:
        """Return schemas and latest values of all topics, or of those of one type. `is_for_all`: all clients get them.

        A little later, latched messages are sent to the client, and large values that are not converted yet to all.
        """
        frames: list[Frame] = []
        topics = [served for served in self._served.values() if type_name in (None, served.subscription.type_name)]
        for served in topics:
            self._sender.show(served, frames)
        if is_for_all:
            self._sender.introduced(frames)
        self._show_latched(queue, topics, may_hold=not self._is_shared)
        return frames

    async def everything(self) -> list[Frame]:
        """Return all schemas, latest values and latched messages."""
        frames: list[Frame] = []
        topics = list(self._served.values())
        for served in topics:
            self._sender.show(served, frames)
        latched = [self._all_latched(served) for served in topics if served.selection.keepers]
        return [*frames, *chain.from_iterable(await asyncio.gather(*latched))]

    async def _all_latched(self, served: ServedTopic) -> list[Frame]:
        async with served.subscription.latched.fetched() as fetched:
            return [frame async for frame in self._sender.latched(served, fetched)]

    def rates(self, seconds: float) -> Iterator[tuple[str, str, float]]:
        """Yield every topic with its type and its rate over the `seconds` since the last call."""
        for topic, served in self._served.items():
            arrived = served.subscription.arrived
            yield topic, served.subscription.type_name, (arrived - served.reported) / seconds
            served.reported = arrived


def _beginning(frames: Iterable[Frame]) -> list[Frame]:
    """Return the first frames, at most LOW_WATER bytes but at least one frame."""
    first: list[Frame] = []
    size = 0
    for frame in frames:
        size += len(frame.data)
        if first and size > LOW_WATER:
            break
        first.append(frame)
    return first
