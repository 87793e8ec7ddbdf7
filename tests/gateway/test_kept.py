"""Fetching the messages that publishers keep, while other things happen to the topic."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import cast

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from router.clock import wall_ns
from router.gateway.kept import MOST_KEPT
from router.gateway.publishers import Selection
from router.gateway.subscriptions import Subscriptions, TopicSubscription
from router.ros.topics import RosTopics
from tests.gateway.asynchronous import asynchronous
from tests.gateway.stage import INTERFACES, Graph, Tap

STRING = "std_msgs/msg/String"
LATCHED = Selection(STRING, is_reliable=True, keeps=True, others=())


class KeptTap(Tap):
    """The messages `kept` come first."""

    def __init__(self, depth: int, kept: list[bytes]) -> None:
        super().__init__(depth)
        for each in kept:
            self.put(each)


class LatchedGraph(Graph):
    """Its publisher keeps messages. `fetch` is the latest subscription that fetches them, `main` the other one."""

    fetch: Tap | None = None
    main: Tap

    def __init__(self) -> None:
        super().__init__({"/greeting": STRING})

    def tap(self, topic: str, message_class: object, *, is_reliable: bool, keeps: bool, depth: int) -> Tap:
        tap = KeptTap(depth, [b"a", b"b"])
        if depth == MOST_KEPT:
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
    async with topic.kept.fetched() as kept:
        return [sample.cdr for sample in kept.samples]


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

        monkeypatch.setattr(KeptTap, "close", close)
        assert await messages(topic) == [b"a", b"b"]
        assert await others[0] == [b"a", b"b"]


@asynchronous
async def test_a_fetch_ends_on_a_topic_that_is_faster_than_it(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = LatchedGraph()
    with latched(graph) as topic:
        monkeypatch.setattr(KeptTap, "take", lambda _: (b"again", wall_ns()))
        assert await asyncio.wait_for(messages(topic), 20.0) == [b"again"] * MOST_KEPT
