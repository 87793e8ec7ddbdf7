"""Fetching the messages that publishers keep, while other things happen to the topic."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from time import monotonic
from typing import cast

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from router.clock import wall_ns
from router.gateway.encoding import LARGE, Sample
from router.gateway.latched import MOST_LATCHED, MOST_LATCHED_BYTES, QUIET_S
from router.gateway.publishers import Selection
from router.gateway.subscriptions import Subscriptions, TopicSubscription
from router.ros.topics import DiscoveredPublisher, RosTopics
from tests.gateway.asynchronous import asynchronous, until
from tests.gateway.stage import INTERFACES, Graph, Tap

STRING = "std_msgs/msg/String"
LATCHED = Selection(STRING, is_reliable=True, keeps=True, others=())


class LatchedTap(Tap):
    """The messages `latched` come first."""

    def __init__(self, depth: int, latched: list[bytes]) -> None:
        super().__init__(depth)
        for each in latched:
            self.put(each)


class LatchedGraph(Graph):
    """Its publisher keeps messages. `fetch` is the latest subscription that fetches them, `main` the other one."""

    fetch: Tap | None = None
    main: Tap

    def __init__(self) -> None:
        super().__init__({"/greeting": STRING})

    def tap(self, topic: str, message_class: object, *, is_reliable: bool, keeps: bool, depth: int) -> Tap:
        tap = LatchedTap(depth, [b"a", b"b"])
        if depth == MOST_LATCHED:
            self.fetch = tap
        else:
            self.main = tap
        return tap


@contextmanager
def latched(graph: LatchedGraph) -> Iterator[TopicSubscription]:
    subscriptions = Subscriptions(cast("RosTopics", graph), INTERFACES, asyncio.get_running_loop())
    with closing(subscriptions):
        yield subscriptions.join("/greeting", LATCHED, None)


async def messages(topic: TopicSubscription) -> list[bytes]:
    async with topic.latched.fetched() as fetched:
        return [sample.cdr for sample in fetched.samples]


@asynchronous
async def test_a_change_of_qos_does_not_interrupt_a_fetch() -> None:
    graph = LatchedGraph()
    with latched(graph) as topic:
        fetching = asyncio.create_task(messages(topic))
        while graph.fetch is None:
            await asyncio.sleep(0)
        topic.add(LATCHED._replace(keeps=False), None)
        assert await fetching == [b"a", b"b"]


@asynchronous
async def test_a_fetch_that_begins_when_another_ends_takes_nothing_from_it(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = LatchedGraph()
    with latched(graph) as topic:
        others: list[asyncio.Task[list[bytes]]] = []

        def close(tap: Tap) -> None:
            monkeypatch.undo()
            if tap is graph.fetch:  # a message and the next client come as soon as the fetch is over
                graph.main.put(b"c")
                others.append(asyncio.create_task(messages(topic)))
            tap.close()

        monkeypatch.setattr(LatchedTap, "close", close)
        assert await messages(topic) == [b"a", b"b"]
        assert await others[0] == [b"a", b"b"]


@asynchronous
async def test_a_fetch_ends_on_a_topic_that_is_faster_than_it(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = LatchedGraph()
    with latched(graph) as topic:
        monkeypatch.setattr(LatchedTap, "take", lambda _: (b"again", wall_ns()))
        assert await asyncio.wait_for(messages(topic), 20.0) == [b"again"] * MOST_LATCHED


class SlowTap(Tap):
    """Its messages come one by one, with pauses that are longer than a busy topic's."""

    def __init__(self, depth: int, messages: list[bytes], closed: Callable[[], None] = lambda: None) -> None:
        super().__init__(depth)
        self._closed = closed
        self._messages = [(each, number + 1) for number, each in enumerate(messages)]
        self._next = 0.0

    def take(self) -> tuple[bytes, int] | None:
        if not self._messages or monotonic() < self._next:
            return None
        self._next = monotonic() + 4 * QUIET_S
        return self._messages.pop(0)

    def close(self) -> None:
        self._closed()
        super().close()


class SlowGraph(LatchedGraph):
    """Each of its topics has one publisher, which keeps `messages`. `fetching` topics have a subscription now."""

    def __init__(self, messages: list[bytes], *topics: str) -> None:
        super().__init__()
        self.messages = messages
        self.types = dict.fromkeys(topics, STRING)
        self.fetching: list[str] = []
        self.most_at_once = 0

    def publishers(self, topic: str) -> list[DiscoveredPublisher]:
        return [DiscoveredPublisher(STRING, is_reliable=True, keeps=True, is_ours=False, gid=b"one")]

    def tap(self, topic: str, message_class: object, *, is_reliable: bool, keeps: bool, depth: int) -> Tap:
        if depth != MOST_LATCHED:
            return SlowTap(depth, self.messages[-1:])
        self.fetching.append(topic)
        self.most_at_once = max(self.most_at_once, len(self.fetching))
        return SlowTap(depth, list(self.messages), lambda: self.fetching.remove(topic))


@asynchronous
async def test_messages_that_come_slowly_are_all_fetched() -> None:
    said = [b"%d" % number for number in range(4)]
    subscriptions = Subscriptions(
        cast("RosTopics", SlowGraph(said, "/greeting")), INTERFACES, asyncio.get_running_loop()
    )
    with closing(subscriptions):
        topic = subscriptions.join("/greeting", LATCHED, None)
        topic.latest()
        topic._last = Sample("/greeting", topic._type, said[-1], len(said))
        assert await messages(topic) == said
        assert subscriptions.fetches.reserved == sum(map(len, said))
        await until(lambda: subscriptions.fetches.reserved == 0)


@asynchronous
async def test_large_messages_are_fetched_one_topic_at_a_time_within_one_bound(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("router.gateway.latched.REPAIR_S", 0.1)
    monkeypatch.setattr("router.gateway.latched.MOST_FETCHED_BYTES", MOST_LATCHED_BYTES + LARGE)
    names = [f"/map{number}" for number in range(4)]
    graph = SlowGraph([bytes(2 * LARGE)], *names)
    subscriptions = Subscriptions(cast("RosTopics", graph), INTERFACES, asyncio.get_running_loop())
    with closing(subscriptions):
        topics = [subscriptions.join(name, LATCHED, None) for name in names]
        for topic in topics:
            topic._last = Sample(topic.topic, topic._type, graph.messages[0], 1)
        assert await asyncio.gather(*map(messages, topics)) == [graph.messages] * 4
        assert graph.most_at_once == 1
        assert subscriptions.fetches.reserved <= MOST_LATCHED_BYTES + LARGE
        await until(lambda: subscriptions.fetches.reserved == 0)
