"""What comes in on ROS topics, once for all gateways: one subscription for a topic, however many follow it.

Knows no client, and no gateway but as a callback. All of it is for the loop's thread, unless it says otherwise.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from router.compiler.lookup import layout
from router.errors import StartError, TableError
from router.gateway.following import Choice, choice
from router.gateway.samples import ReadyType, Sample
from router.types.ros import RosInterfaces

if TYPE_CHECKING:  # which imports rclpy
    from router.edges.ros_topics import RosTopics, TopicTap

__all__ = ["Each", "Feed", "Hub", "Sample"]

DEPTH = 100
"""Messages that wait on a topic of which every one is wanted; the oldest go first."""

TURN = 32
"""Messages of one topic that are served before others have their turn."""


class Feed:
    """What comes in on one topic as one type, for all who follow it: the latest value, or each message.

    Where the latest value is enough, the middleware keeps one message, and what nobody asks for costs no Python.
    """

    def __init__(self, topic: str, ready: ReadyType, topics: RosTopics, loop: asyncio.AbstractEventLoop) -> None:
        self.topic = topic
        self.type_name = ready.message.name
        self.message = ready.message
        self.schema = ready.schema
        self._type = ready
        self._topics = topics
        self._loop = loop
        self._followers = 0
        self._eaches: tuple[Each, ...] = ()
        self._tap: TopicTap | None = None
        self._is_reliable = self._keeps = False
        self._depth = 1
        self._arrived = self._taken = self._missed = 0
        self._is_even = False  # `_taken` counts from when it was level with `_arrived`
        self._waits = False  # something has come that was not taken
        self._turn: asyncio.Handle | None = None
        self._last: Sample | None = None

    @property
    def arrived(self) -> int:
        """Messages that have come in since the feed was made, taken or not."""
        if not self._eaches:
            self._count()
        return self._arrived

    @property
    def missed(self) -> int:
        """Messages so far that were to be handed on, and gave way to newer ones in the middleware's queue before."""
        return self._missed

    @property
    def is_open(self) -> bool:
        """Not so once somebody follows the topic as another type, or nobody does: then join again, or leave."""
        return self._tap is not None

    @property
    def is_followed(self) -> bool:
        return self._followers > 0

    def latest(self) -> Sample | None:
        """The newest message that was taken. Takes what waits, unless that is handed on anyway."""
        if not self._eaches:
            self._count()
            if self._waits:
                self._waits = False
                self._take(self._depth)
        return self._last

    def follow(self, wanted: Choice, each: Each | None) -> None:
        """One follower more. Subscribes, anew if that was with another QoS or not deep enough.

        What had come by then is for those who followed before. Raises StartError.
        """
        # It stays deep: to go back would lose what comes meanwhile.
        depth = DEPTH if each or self._eaches else self._depth
        if (wanted.is_reliable, wanted.keeps, depth) != (self._is_reliable, self._keeps, self._depth):
            self._take(self._depth)
            self.close()
        if self._tap is None:
            self._tap = self._topics.tap(
                self.topic, self._type.message_class, is_reliable=wanted.is_reliable, keeps=wanted.keeps, depth=depth
            )
            self._is_reliable, self._keeps, self._depth = wanted.is_reliable, wanted.keeps, depth
        self._followers += 1
        if each:
            self._is_even = self._is_even and bool(self._eaches)
            self._eaches += (each,)
        self._listen(self._tap)

    def unfollow(self, each: Each | None) -> None:
        self._followers -= 1
        if each:
            place = self._eaches.index(each)
            self._eaches = self._eaches[:place] + self._eaches[place + 1 :]
        if self._tap:
            self._listen(self._tap)

    def close(self) -> None:
        """Nothing comes in any more; `latest` and `arrived` stay what they are."""
        if self._tap is None:
            return
        self._count()
        if self._turn:
            self._turn.cancel()
            self._turn = None
        self._loop.remove_reader(self._tap.fd)
        self._tap.close()
        self._tap = None

    def _listen(self, tap: TopicTap) -> None:
        """Has messages handed on when they come, if anybody wants that."""
        if not self._eaches:
            self._loop.remove_reader(tap.fd)
            return
        self._loop.add_reader(tap.fd, self._on_arrival)
        if self._turn is None:
            self._turn = self._loop.call_soon(self._on_turn)  # what was counted while nobody wanted it

    def _on_arrival(self) -> None:
        self._count()
        if self._turn is None:
            self._serve()

    def _on_turn(self) -> None:
        self._turn = None
        self._count()
        self._serve()

    def _serve(self) -> None:
        """What was counted by now is taken here, or was lost."""
        if self._take(TURN) == TURN:
            self._turn = self._loop.call_soon(self._on_turn)
        elif self._is_even:
            self._missed = max(self._missed, self._arrived - self._taken)
        else:
            self._is_even, self._taken = True, self._arrived - self._missed

    def _count(self) -> None:
        if self._tap and (came := self._tap.arrived()):
            self._arrived += came
            self._waits = True

    def _take(self, most: int) -> int:
        """How many messages were taken. Each is handed on to those who want that, and the last one is remembered."""
        taken = 0
        while taken < most and self._tap and (message := self._tap.take()):
            taken += 1
            self._taken += 1
            self._last = Sample(self.topic, self._type, *message)
            for each in self._eaches:
                self._hand_on(each, self._last)
        return taken

    def _hand_on(self, each: Each, sample: Sample) -> None:
        try:
            each(self, sample)
        except Exception as error:  # noqa: BLE001 told loudly; the next message and the next gateway matter as much
            self._loop.call_exception_handler({"message": f"a message of {self.topic} was lost", "exception": error})


Each = Callable[[Feed, Sample], None]


class Hub:
    """The topics that can be followed, and a feed for each that is. Close it."""

    def __init__(self, ros: RosTopics, interfaces: RosInterfaces, loop: asyncio.AbstractEventLoop) -> None:
        self._topics = ros
        self._interfaces = interfaces
        self._loop = loop
        self._feeds: dict[str, Feed] = {}
        self._types: dict[str, ReadyType | str] = {}  # or why not
        self._loader = ThreadPoolExecutor(1, thread_name_prefix="gateway types")

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
        feed = self._feeds.get(topic)
        if feed and feed.type_name != wanted.type_name:
            feed.close()  # first: DDS has one type for a topic in a process
            feed = None
        if feed is None:
            feed = self._feeds[topic] = Feed(topic, ready, self._topics, self._loop)
        try:
            feed.follow(wanted, each)
        except StartError:
            del self._feeds[topic]
            raise
        return feed

    def leave(self, feed: Feed, each: Each | None) -> None:
        """With the `each` that it was joined with."""
        feed.unfollow(each)
        if not feed.is_followed:
            feed.close()
            if self._feeds.get(feed.topic) is feed:
                del self._feeds[feed.topic]

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
            message = self._interfaces.get(type_name)
            if message is None:
                return f"{type_name} is not installed"
            return ReadyType(message, self._topics.load(type_name, layout(message)))
        except (StartError, TableError) as error:
            return str(error)
