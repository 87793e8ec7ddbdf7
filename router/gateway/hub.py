"""The ROS topics that gateways can follow, and the feeds of those that are followed, with their types made ready.

All of it is for the loop's thread, unless it says otherwise.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from router.compiler.lookup import layout
from router.errors import StartError, TableError
from router.gateway.feeds import Each, Feed
from router.gateway.following import Choice, choice
from router.gateway.samples import ReadyType
from router.types.model import MessageType
from router.types.ros import RosInterfaces

if TYPE_CHECKING:  # which imports rclpy
    from router.ros.topics import RosTopics


class Hub:
    """The topics that can be followed, and a feed for each way in which one is. Close it."""

    def __init__(self, ros: RosTopics, interfaces: RosInterfaces, loop: asyncio.AbstractEventLoop) -> None:
        self._topics = ros
        self._interfaces = interfaces
        self._loop = loop
        self._feeds: dict[tuple[str, bool], Feed] = {}  # by topic, and whether each message is wanted
        self._types: dict[str, ReadyType | str] = {}  # or why not
        self._loader = ThreadPoolExecutor(1, thread_name_prefix="gateway types")

    def resolved(self, names: Iterable[str]) -> frozenset[str]:
        """The absolute names that ROS makes of these."""
        return frozenset(map(self._topics.resolved, names))

    async def look(self, let_in: Collection[str], wanted: Callable[[str], bool]) -> dict[str, Choice]:
        """The topics among those `wanted` that somebody publishes on; our own publishers do not count on `let_in`.

        Types are made ready here, so that `join` does not take long. Others have their turn between topics.
        """
        seen: dict[str, Choice] = {}
        for topic in self._topics.names():
            await asyncio.sleep(0)
            if not wanted(topic):
                continue
            if picked := choice(self._topics.publishers(topic), is_let_in=topic in let_in):
                seen[topic] = picked
                if picked.type_name not in self._types:
                    ready = await self._loop.run_in_executor(self._loader, self._load, picked.type_name)
                    self._types[picked.type_name] = ready
        return seen

    def join(self, topic: str, wanted: Choice, each: Each | None) -> Feed:
        """Follows `topic`: `each` is called for every message, without it `latest` is there to be asked.

        To follow another choice, join again and leave the old feed, which may be the same, afterwards. A feed of
        another type ends here, whoever follows it. Raises StartError, and then nobody follows.
        """
        ready = self._ready(wanted.type_name)
        for way in ((topic, False), (topic, True)):
            if (other := self._feeds.get(way)) and other.type_name != wanted.type_name:
                other.close()  # first: DDS has one type for a topic in a process
                del self._feeds[way]
        key = topic, each is not None
        if (feed := self._feeds.get(key)) is None:
            feed = self._feeds[key] = Feed(topic, ready, self._topics, self._loop, is_each=each is not None)
        try:
            feed.follow(wanted, each)
        except StartError:
            del self._feeds[key]
            raise
        return feed

    def leave(self, feed: Feed, each: Each | None) -> None:
        """With the `each` that it was joined with."""
        feed.unfollow(each)
        if not feed.is_followed:
            feed.close()
            if self._feeds.get(key := (feed.topic, each is not None)) is feed:
                del self._feeds[key]

    def close(self) -> None:
        for feed in self._feeds.values():
            feed.close()
        self._feeds.clear()
        self._loader.shutdown()

    def _ready(self, type_name: str) -> ReadyType:
        if (ready := self._types.get(type_name)) is None:
            ready = self._types[type_name] = self._load(type_name)
        if isinstance(ready, str):
            raise StartError(ready)
        return ready

    def _load(self, type_name: str) -> ReadyType | str:
        """Or why not. Runs in a thread of its own, but for types that were not looked for."""
        try:
            message = self._declared(type_name) or self._topics.installed_type(type_name)
            return ReadyType(message, self._topics.load(type_name, layout(message)))
        except StartError as error:
            return str(error)

    def _declared(self, type_name: str) -> MessageType | None:
        """By a `.msg` file. None where that cannot be read, or nests what has none, also: the class may well say it."""
        try:
            return self._interfaces.get(type_name)
        except TableError:
            return None
