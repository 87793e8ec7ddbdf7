"""Latched messages: those that publishers of a topic keep for late joiners (`transient_local`)."""

from __future__ import annotations

import asyncio
from collections import OrderedDict, deque
from collections.abc import AsyncIterator, Callable, Hashable, Sequence
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

from router.clock import wall_ns
from router.errors import StartError
from router.gateway.encoding import LARGE, ReadyType, Sample
from router.gateway.publishers import keepers
from router.gateway.transport.base import PER_TURN, Frame
from router.log import logger

if TYPE_CHECKING:  # which imports rclpy
    from router.ros.topics import RosTopics, TopicTap

MOST_LATCHED = 1000
MOST_LATCHED_BYTES = 64 << 20
"""Maximum messages of one topic, and their bytes, that late joiners get: the newest ones."""

FIRST_BYTES = 8 << 20
"""Bytes that are reserved for the messages of a topic during a fetch, unless they are large or turn out to be more."""

MOST_FETCHED_BYTES = 2 * MOST_LATCHED_BYTES
"""Maximum bytes of fetched messages of all topics, and of the frames made from them."""

POLL_S = 0.02
QUIET_S = 0.3
"""Publishers have delivered everything when no latched message has arrived for this long."""

PATIENCE_S = 2.0
"""How long to wait for publishers that deliver nothing: they may have published nothing yet."""

REPAIR_S = 4.0
"""How long to wait in both cases if messages are large: Fast DDS sends a lost fragment again after 3 s."""

LIMIT_S = 20.0
"""The longest fetch: new messages of a publisher whose clock is behind look like latched ones."""

FRESH_S = 1.0
"""How long fetched messages are reused if none arrives, so that many clients cost few subscriptions."""


class Fetched:
    """Fetched messages, and how many had `arrived` on the topic when the last one was taken.

    `frames` has the latest of their frames, by gateway and message, which the clients of a gateway share. `users` is
    how many clients are being sent the messages.
    """

    def __init__(self, samples: Sequence[Sample] = (), arrived: int = -1, reserved: int = 0) -> None:
        self.samples = samples
        self.arrived = arrived
        self.reserved = reserved
        self.users = 0
        self._frames: OrderedDict[Hashable, Frame] = OrderedDict()
        self._size = 0

    def frame(self, key: Hashable) -> Frame | None:
        return self._frames.get(key)

    def remember(self, key: Hashable, frame: Frame) -> None:
        """Remember a frame, and forget the oldest ones if there are too many."""
        if key not in self._frames:
            self._frames[key] = frame
            self._size += len(frame.data)
        while self._size > self.reserved and len(self._frames) > 1:
            self._size -= len(self._frames.popitem(last=False)[1].data)


class FetchBudget:
    """Limits the bytes of fetched messages, of all topics: fetches wait until there is room.

    `large` lets one fetch of large messages run at a time: several at once overflow the buffers of the middleware,
    which then sends lost fragments again every 3 s.
    """

    def __init__(self) -> None:
        self.reserved = 0
        self.large = asyncio.Lock()
        self._owners: list[LatchedMessages] = []
        self._waiting: deque[asyncio.Future[None]] = deque()

    async def reserve(self, size: int) -> None:
        """Wait until there is room for `size` bytes. Messages that are sent to nobody make room."""
        while self.reserved + size > MOST_FETCHED_BYTES:
            if (idle := next((each for each in self._owners if each.is_idle), None)) is not None:
                idle.forget()
                continue
            room = asyncio.get_running_loop().create_future()
            self._waiting.append(room)
            await room
        self.reserved += size

    def release(self, size: int) -> None:
        self.reserved -= size
        self.recheck()

    def recheck(self) -> None:
        """Let all fetches that wait check again."""
        while self._waiting:
            if not (room := self._waiting.popleft()).done():
                room.set_result(None)

    def add(self, owner: LatchedMessages) -> None:
        self._owners.append(owner)

    def remove(self, owner: LatchedMessages) -> None:
        self._owners.remove(owner)


class _TooMuchError(Exception):
    """The messages exceed what is reserved for them."""


class LatchedMessages:
    """Fetches the messages from the publishers with a short-lived subscription.

    They are not cached here: only a publisher knows how many messages it keeps, and they vanish with it. `arrived`
    returns the number of messages that have arrived on the topic so far, `latest` the newest of them
    if all publishers keep messages.
    """

    def __init__(
        self,
        topic: str,
        ready: ReadyType,
        topics: RosTopics,
        loop: asyncio.AbstractEventLoop,
        arrived: Callable[[], int],
        latest: Callable[[], Sample | None],
        budget: FetchBudget,
    ) -> None:
        self._topic = topic
        self._ready = ready
        self._topics = topics
        self._loop = loop
        self._arrived = arrived
        self._latest = latest
        self._budget = budget
        self._is_large = False
        self._asking: asyncio.Task[Fetched] | None = None
        self._waiting = 0
        self._found: Fetched | None = None
        self._found_from: frozenset[bytes] = frozenset()
        self._is_old = False
        self._aging: asyncio.TimerHandle | None = None

    @asynccontextmanager
    async def fetched(self) -> AsyncIterator[Fetched]:
        """Give the messages in the order of publication. Concurrent calls share one subscription.

        The result is empty if the subscription fails, which is logged, or is closed meanwhile.
        """
        self._waiting += 1
        try:
            fetched = await self._get()
            fetched.users += 1
        finally:
            self._waiting -= 1
        try:
            yield fetched
        finally:
            fetched.users -= 1
            if fetched is not self._found:
                self._free(fetched)
            else:
                self._forget_if_old()
                self._budget.recheck()  # it may be idle now

    @property
    def is_idle(self) -> bool:
        """Whether there are fetched messages, and nobody is being sent them."""
        return self._found is not None and not self._found.users and not self._waiting

    async def _get(self) -> Fetched:
        if (asking := self._asking) is None:
            publishers = keepers(self._topics.publishers(self._topic), self._ready.message.name)
            found = self._found
            if found and not self._is_old and (found.arrived, self._found_from) == (self._arrived(), publishers):
                return found
            asking = self._asking = self._loop.create_task(self._ask(publishers))
        await asyncio.wait([asking])  # it continues for others if this call is cancelled
        return Fetched() if asking.cancelled() else asking.result()

    def close(self) -> None:
        """Unsubscribe, and forget the messages."""
        if self._asking:
            self._asking.cancel()
            self._asking = None
        self.forget()

    def forget(self) -> None:
        """Forget the fetched messages, once they are sent to nobody."""
        if self._aging:
            self._aging.cancel()
            self._aging = None
        if (found := self._found) is not None:
            self._found = None
            self._budget.remove(self)
            self._free(found)

    def _forget_if_old(self) -> None:
        if self.is_idle and self._is_old:
            self.forget()

    def _age(self) -> None:
        self._is_old = True
        self._forget_if_old()

    def _free(self, fetched: Fetched) -> None:
        if not fetched.users:
            size, fetched.reserved = fetched.reserved, 0
            self._budget.release(size)

    async def _ask(self, publishers: frozenset[bytes]) -> Fetched:
        self.forget()
        newest = self._latest()
        self._is_large |= newest is not None and len(newest.cdr) > LARGE
        try:
            found = await self._fetch_all(len(publishers))
        except StartError as error:
            logger.warning(
                "cannot fetch the messages that publishers keep for late joiners", topic=self._topic, error=str(error)
            )
            found = Fetched()
        if found.reserved:
            self._found, self._found_from = found, publishers
            self._budget.add(self)
            self._is_old = False
            self._aging = self._loop.call_later(FRESH_S, self._age)
        self._asking = None
        return found

    async def _fetch_all(self, publishers: int) -> Fetched:
        """Fetch the messages. Raises StartError."""
        if not self._is_large:
            try:
                return await self._fetch(publishers, FIRST_BYTES)
            except _TooMuchError:
                self._is_large = True
        async with self._budget.large:
            return await self._fetch(publishers, MOST_LATCHED_BYTES)

    async def _fetch(self, publishers: int, reserved: int) -> Fetched:
        """Fetch the messages within `reserved` bytes. Raises _TooMuchError, StartError."""
        await self._budget.reserve(reserved)
        fetched: Fetched | None = None
        try:
            tap = self._topics.tap(
                self._topic, self._ready.message_class, is_reliable=True, keeps=True, depth=MOST_LATCHED
            )
            try:
                fetched = await self._collect(tap, publishers, reserved)
            finally:
                tap.close()
            self._budget.release(reserved - fetched.reserved)
            return fetched
        finally:
            if fetched is None:
                self._budget.release(reserved)

    async def _collect(self, tap: TopicTap, publishers: int, reserved: int) -> Fetched:
        """Take messages until all that were published before have arrived.

        A publisher delivers its messages in order. If there is only one, the newest message of the topic is the last.
        Otherwise nobody knows how many there are, and the end is a pause.
        """
        newest = self._latest() if publishers == 1 else None
        samples: deque[Sample] = deque()
        size, is_complete = 0, False
        begun_ns = wall_ns()
        begun = last = self._loop.time()
        while True:
            arrived = self._arrived()
            await asyncio.sleep(POLL_S)
            taken = 0
            while taken < MOST_LATCHED and (message := tap.take()):
                taken += 1
                sample = Sample(self._topic, self._ready, *message)
                if sample.sent_ns <= begun_ns:
                    last = self._loop.time()
                is_complete |= newest is not None and sample.sent_ns >= newest.sent_ns
                self._is_large |= len(sample.cdr) > LARGE
                samples.append(sample)
                size += len(sample.cdr)
                if size > reserved == FIRST_BYTES:
                    raise _TooMuchError
                while len(samples) > MOST_LATCHED or (size > MOST_LATCHED_BYTES and len(samples) > 1):
                    size -= len(samples.popleft().cdr)
                if taken % PER_TURN == 0:
                    await asyncio.sleep(0)
            now = self._loop.time()
            pause = QUIET_S if newest is None and len(samples) >= publishers else PATIENCE_S
            is_quiet = now - last > (max(pause, REPAIR_S) if self._is_large else pause)
            if is_complete or is_quiet or now - begun > LIMIT_S:
                return Fetched(sorted(samples, key=lambda sample: sample.sent_ns), arrived, max(size, 1))
