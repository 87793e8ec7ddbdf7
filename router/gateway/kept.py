"""The messages that publishers of a topic keep for late joiners (`transient_local`)."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

from router.errors import StartError
from router.gateway.encoding import ReadyType, Sample
from router.gateway.publishers import keepers
from router.gateway.transport.base import PER_TURN
from router.log import logger

if TYPE_CHECKING:  # which imports rclpy
    from router.ros.topics import RosTopics, TopicTap

MOST_KEPT = 1000
MOST_KEPT_BYTES = 64 << 20
"""Maximum messages of one topic, and their bytes, that late joiners get: the newest ones."""

POLL_S = 0.02
QUIET_S = 0.1
"""Publishers have delivered everything when nothing has arrived for this long."""

AT_MOST_S = 0.5
"""The longest wait on a topic that is never quiet."""

PATIENCE_S = 2.0
"""How long to wait for publishers that deliver nothing: they may have published nothing yet."""

FRESH_S = 1.0
"""How long fetched messages are reused if none arrives, so that many clients cost few subscriptions."""


class Kept(NamedTuple):
    """Fetched messages, and how many had `arrived` on the topic when the last one was taken."""

    samples: Sequence[Sample] = ()
    arrived: int = -1


class KeptMessages:
    """Fetches the messages from the publishers with a short-lived subscription.

    They are not cached here: only a publisher knows how many messages it keeps, and they vanish with it. `arrived`
    returns the number of messages that have arrived on the topic so far.
    """

    def __init__(
        self,
        topic: str,
        ready: ReadyType,
        topics: RosTopics,
        loop: asyncio.AbstractEventLoop,
        arrived: Callable[[], int],
    ) -> None:
        self._topic = topic
        self._ready = ready
        self._topics = topics
        self._loop = loop
        self._arrived = arrived
        self._tap: TopicTap | None = None
        self._asking: asyncio.Task[Kept] | None = None
        self._found: Kept | None = None
        self._found_from: frozenset[bytes] = frozenset()
        self._forgetting: asyncio.TimerHandle | None = None

    async def get(self) -> Kept:
        """Return the messages in the order of publication. Concurrent calls share one subscription.

        The result is empty if the subscription fails, which is logged, or is closed meanwhile.
        """
        if (asking := self._asking) is None:
            publishers = keepers(self._topics.publishers(self._topic), self._ready.message.name)
            if self._found and (self._found.arrived, self._found_from) == (self._arrived(), publishers):
                return self._found
            asking = self._asking = self._loop.create_task(self._ask(publishers))
        await asyncio.wait([asking])  # it continues for others if this call is cancelled
        return Kept() if asking.cancelled() else asking.result()

    def close(self) -> None:
        """Unsubscribe, and forget the messages."""
        if self._asking:
            self._asking.cancel()
            self._asking = None
        if self._tap:
            self._tap.close()
            self._tap = None
        self._forget()

    async def _ask(self, publishers: frozenset[bytes]) -> Kept:
        self._forget()
        found = Kept()
        try:
            self._tap = self._topics.tap(
                self._topic, self._ready.message_class, is_reliable=True, keeps=True, depth=MOST_KEPT
            )
        except StartError as error:
            logger.warning(
                "cannot fetch the messages that publishers keep for late joiners", topic=self._topic, error=str(error)
            )
        else:
            found = self._found = await self._collect(self._tap, len(publishers))
            self._found_from = publishers
            self._tap.close()
            self._tap = None
            self._forgetting = self._loop.call_later(FRESH_S, self._forget)
        self._asking = None
        return found

    async def _collect(self, tap: TopicTap, publishers: int) -> Kept:
        samples: deque[Sample] = deque()
        size = 0
        begun = last = self._loop.time()
        while True:
            arrived = self._arrived()
            await asyncio.sleep(POLL_S)
            taken = 0
            while taken < MOST_KEPT and (message := tap.take()):
                taken, last = taken + 1, self._loop.time()
                samples.append(Sample(self._topic, self._ready, *message))
                size += len(message[0])
                while len(samples) > MOST_KEPT or (size > MOST_KEPT_BYTES and len(samples) > 1):
                    size -= len(samples.popleft().cdr)
                if taken % PER_TURN == 0:
                    await asyncio.sleep(0)
            now = self._loop.time()
            is_quiet = len(samples) >= publishers and now - last > QUIET_S
            is_late = now - begun > (AT_MOST_S if len(samples) >= publishers else PATIENCE_S)
            if is_quiet or is_late:
                return Kept(sorted(samples, key=lambda sample: sample.sent_ns), arrived)

    def _forget(self) -> None:
        self._found = None
        if self._forgetting:
            self._forgetting.cancel()
            self._forgetting = None
