"""Subscriptions that gateways share: one for all that want each message of a topic, one for all that want the latest.

All of it is for the loop's thread.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TYPE_CHECKING

from router.gateway.following import Choice
from router.gateway.samples import ReadyType, Sample

if TYPE_CHECKING:  # which imports rclpy
    from router.ros.topics import RosTopics, TopicTap

DEPTH = 100
"""Messages that wait on a topic of which every one is wanted; the oldest go first."""

TURN = 32
"""Messages of one topic that are served before others have their turn."""


class Feed:
    """What comes in on one topic as one type: the latest value, or each message, for all who follow it in this way.

    A follower that wants it in the other way has another feed: to subscribe anew would have publishers deliver again
    what they keep for late joiners. Where the latest value is enough, the middleware keeps one message, and what
    nobody asks for costs no Python.
    """

    def __init__(
        self, topic: str, ready: ReadyType, topics: RosTopics, loop: asyncio.AbstractEventLoop, *, is_each: bool
    ) -> None:
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
        self._depth = DEPTH if is_each else 1
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
        """Add a follower, with an `each` where every message is wanted. Subscribe, anew if that was with another QoS.

        What had come by then is for those who followed before. Raises StartError.
        """
        if (wanted.is_reliable, wanted.keeps) != (self._is_reliable, self._keeps):
            self._take(self._depth)
            self.close()
        if self._tap is None:
            self._tap = self._topics.tap(
                self.topic,
                self._type.message_class,
                is_reliable=wanted.is_reliable,
                keeps=wanted.keeps,
                depth=self._depth,
            )
            self._is_reliable, self._keeps = wanted.is_reliable, wanted.keeps
        self._followers += 1
        if each:
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
        """Return how many messages were taken. Hand on each to those who want that, and remember the last one.

        Drop one that equals the last: its publisher keeps it, and delivered it again to a new subscription.
        """
        taken = 0
        while taken < most and self._tap and (message := self._tap.take()):
            taken += 1
            self._taken += 1
            cdr, sent_ns = message
            if self._last and (sent_ns, cdr) == (self._last.sent_ns, self._last.cdr):
                continue
            self._last = Sample(self.topic, self._type, cdr, sent_ns)
            for each in self._eaches:
                self._hand_on(each, self._last)
        return taken

    def _hand_on(self, each: Each, sample: Sample) -> None:
        try:
            each(self, sample)
        except Exception as error:  # noqa: BLE001 told loudly; the next message and the next gateway matter as much
            self._loop.call_exception_handler({"message": f"a message of {self.topic} was lost", "exception": error})


Each = Callable[[Feed, Sample], None]
