"""Subscriptions to ROS topics, shared by all gateways of a router.

A topic has at most two: one for gateways that send every message, one for gateways that send the latest value.
Everything runs in the thread of the event loop, unless stated otherwise.
"""

from __future__ import annotations

import asyncio
import ctypes
from collections.abc import Callable, Collection, Iterable
from typing import TYPE_CHECKING

from router.compiler.lookup import definitions_of
from router.errors import StartError, TableError
from router.gateway.encoding import ReadyType, Sample
from router.gateway.latched import FetchBudget, LatchedMessages
from router.gateway.publishers import Selection, select
from router.gateway.transport.base import PER_TURN
from router.threads import DaemonThread
from router.types.model import MessageType
from router.types.ros import RosInterfaces

if TYPE_CHECKING:  # which imports rclpy
    from router.ros.topics import RosTopics, TopicTap

DEPTH = 100
"""Queue length of a subscription to every message; the oldest are dropped first."""


MANY = 100
"""Closed subscriptions after which freed memory is returned to the system."""

RETURN_S = 5.0
"""How long after that: the middleware frees some of it later."""


def return_freed_memory() -> None:
    """Have glibc return freed memory, which for subscriptions lies between small blocks that are in use.

    Threads that allocate meanwhile may wait: 500 subscriptions take 6 ms.
    """
    ctypes.CDLL(None).malloc_trim(0)


class NotInstalledError(StartError):
    """A type that cannot be received here."""


class TopicSubscription:
    """A subscription to one topic as one type, to every message or the latest value, shared by gateways.

    The two modes do not share a subscription: after subscribing again with another depth, publishers would deliver the
    messages for late joiners again. For the latest value, the middleware keeps one message, and messages that are never
    taken cost no Python.
    """

    def __init__(
        self,
        topic: str,
        ready: ReadyType,
        topics: RosTopics,
        loop: asyncio.AbstractEventLoop,
        budget: FetchBudget,
        *,
        is_each: bool,
    ) -> None:
        self.topic = topic
        self.type_name = ready.message.name
        self.schema = ready.schema
        self._type = ready
        self._topics = topics
        self._loop = loop
        self._users = 0
        self._callbacks: tuple[OnSample, ...] = ()
        self._tap: TopicTap | None = None
        self._is_reliable = self._keeps = False
        self._depth = DEPTH if is_each else 1
        self.missed = 0
        """Messages for callbacks that were replaced by newer ones in the middleware's queue."""
        self._arrived = self._taken = 0
        self._is_synchronised = False  # `_taken` has once been equal to `_arrived`
        self._waits = False  # something arrived that was not taken
        self._turn: asyncio.Handle | None = None
        self._last: Sample | None = None
        self.latched = LatchedMessages(
            topic, ready, topics, loop, lambda: self.arrived, lambda: self.latest() if self._keeps else None, budget
        )
        """The messages that publishers keep for late joiners."""

    @property
    def arrived(self) -> int:
        """Messages that have arrived so far, taken or not."""
        if not self._callbacks:
            self._count()
        return self._arrived

    @property
    def is_open(self) -> bool:
        """Whether it is subscribed. Joining the topic as another type closes it; its users then join again or leave."""
        return self._tap is not None

    @property
    def is_used(self) -> bool:
        return self._users > 0

    def ask(self) -> bool:
        """Ask for a message newer than the `latest` one. Return whether it comes only after `publish_newest`."""
        return self._tap is not None and self._tap.ask()

    def latest(self) -> Sample | None:
        """Return the newest message. Without callbacks, take waiting messages first."""
        if not self._callbacks:
            self._count()
            if self._waits:
                self._waits = False
                self._take(self._depth)
        return self._last

    def add(self, wanted: Selection, callback: OnSample | None) -> None:
        """Add a user, with a `callback` for every message. Subscribe, or subscribe again if the QoS changes.

        Messages that have arrived by then go to the earlier users. Raises StartError.
        """
        if (wanted.is_reliable, wanted.keeps) != (self._is_reliable, self._keeps):
            self._take(self._depth)
            self._unsubscribe()
        if self._tap is None:
            self._tap = self._topics.tap(
                self.topic,
                self._type.message_class,
                is_reliable=wanted.is_reliable,
                keeps=wanted.keeps,
                depth=self._depth,
            )
            self._is_reliable, self._keeps = wanted.is_reliable, wanted.keeps
        self._users += 1
        if callback:
            self._callbacks += (callback,)
        self._watch(self._tap)

    def remove(self, callback: OnSample | None) -> None:
        self._users -= 1
        if callback:
            position = self._callbacks.index(callback)
            self._callbacks = self._callbacks[:position] + self._callbacks[position + 1 :]
        if self._tap:
            self._watch(self._tap)

    def close(self) -> None:
        """Unsubscribe; `latest` and `arrived` keep their values."""
        self.latched.close()
        self._unsubscribe()

    def _unsubscribe(self) -> None:
        if self._tap is None:
            return
        self._count()
        if self._turn:
            self._turn.cancel()
            self._turn = None
        self._loop.remove_reader(self._tap.fd)
        self._tap.close()
        self._tap = None

    def _watch(self, tap: TopicTap) -> None:
        """Let the loop handle messages on arrival, if there are callbacks."""
        if not self._callbacks:
            self._loop.remove_reader(tap.fd)
            return
        self._loop.add_reader(tap.fd, self._on_arrival)
        if self._turn is None:
            self._turn = self._loop.call_soon(self._on_turn)  # for messages counted while there was no callback

    def _on_arrival(self) -> None:
        self._count()
        if self._turn is None:
            self._serve()

    def _on_turn(self) -> None:
        self._turn = None
        self._count()
        self._serve()

    def _serve(self) -> None:
        """Take messages. Messages that were counted but cannot be taken are lost."""
        if self._take(PER_TURN) == PER_TURN:
            self._turn = self._loop.call_soon(self._on_turn)
        elif self._is_synchronised:
            self.missed = max(self.missed, self._arrived - self._taken)
        else:
            self._is_synchronised, self._taken = True, self._arrived - self.missed

    def _count(self) -> None:
        if self._tap and (arrived := self._tap.arrived()):
            self._arrived += arrived
            self._waits = True

    def _take(self, most: int) -> int:
        """Take messages, call back for each, and remember the last one. Return how many were taken.

        A message equal to the last one is skipped: its publisher keeps it, and has delivered it to a new subscription.
        """
        taken = 0
        while taken < most and self._tap and (message := self._tap.take()):
            taken += 1
            self._taken += 1
            cdr, sent_ns = message
            if self._last and (sent_ns, cdr) == (self._last.sent_ns, self._last.cdr):
                continue
            self._last = Sample(self.topic, self._type, cdr, sent_ns)
            for callback in self._callbacks:
                self._call(callback, self._last)
        return taken

    def _call(self, callback: OnSample, sample: Sample) -> None:
        try:
            callback(self, sample)
        except Exception as error:  # noqa: BLE001 reported; other messages and gateways continue
            self._loop.call_exception_handler({"message": f"a message on {self.topic} was lost", "exception": error})


OnSample = Callable[[TopicSubscription, Sample], None]


class Subscriptions:
    """The topics that can be subscribed to, and the subscriptions in use."""

    def __init__(self, ros: RosTopics, interfaces: RosInterfaces, loop: asyncio.AbstractEventLoop) -> None:
        self._topics = ros
        self._interfaces = interfaces
        self._loop = loop
        self._open: dict[tuple[str, bool], TopicSubscription] = {}  # by topic, and whether to every message
        self._types: dict[str, ReadyType | str] = {}  # or the reason why a type cannot be received
        self._loader = DaemonThread("gateway types")
        self.fetches = FetchBudget()
        self._closed = 0  # since memory was last returned
        self._returning: asyncio.TimerHandle | None = None

    def resolved(self, names: Iterable[str]) -> frozenset[str]:
        """Return the absolute names of these topics, as ROS resolves them."""
        return frozenset(map(self._topics.resolved, names))

    def is_of_table(self, topic: str) -> bool:
        """Return whether the table has the topic."""
        return topic in self._topics.types

    async def discover(
        self, inbound: Collection[str], rank: Callable[[str], int | None], most: int
    ) -> tuple[dict[str, Selection], set[str]]:
        """Return topics that have publishers; on `inbound` topics this router's own do not count.

        `rank` is None for topics that are not wanted. The `most` topics of the lowest ranks are selected, and their
        types loaded, so that `join` is fast. Of the others only the names are returned. Yields to other tasks between
        topics.
        """
        selected: dict[str, Selection] = {}
        beyond: set[str] = set()
        ranked: list[tuple[int, str]] = []
        for number, topic in enumerate(self._topics.names(), 1):
            if (place := rank(topic)) is not None:
                ranked.append((place, topic))
            if number % PER_TURN == 0:
                await asyncio.sleep(0)
        for number, (_, topic) in enumerate(sorted(ranked), 1):
            if len(selected) >= most:
                if self._topics.has_publishers(topic):
                    beyond.add(topic)
                if number % PER_TURN == 0:
                    await asyncio.sleep(0)
                continue
            await asyncio.sleep(0)
            publishers, table_type = self._topics.publishers(topic), self._topics.types.get(topic)
            if selection := select(publishers, is_inbound=topic in inbound, table_type=table_type):
                selected[topic] = selection
                if selection.type_name not in self._types:
                    ready = await self._loop.run_in_executor(self._loader, self._load, selection.type_name)
                    self._types[selection.type_name] = ready
        return selected, beyond

    def is_joined(self, topic: str, callback: OnSample | None) -> bool:
        """Return whether the subscription that `join` with this `callback` would use exists."""
        return (topic, callback is not None) in self._open

    def join(self, topic: str, wanted: Selection, callback: OnSample | None) -> TopicSubscription:
        """Use a subscription. `callback` is called for every message; without one, call `latest`.

        To change the selection, join again and leave the old subscription, which may be the same, afterwards. A
        subscription of another type is closed for all its users. Raises StartError, NotInstalledError for the type;
        then nothing was joined.
        """
        ready = self._ready(wanted.type_name)
        for key in ((topic, False), (topic, True)):
            if (other := self._open.get(key)) and other.type_name != wanted.type_name:
                other.close()  # first: DDS allows one type per topic in a process
                del self._open[key]
        key = topic, callback is not None
        if (subscription := self._open.get(key)) is None:
            subscription = TopicSubscription(
                topic, ready, self._topics, self._loop, self.fetches, is_each=callback is not None
            )
            self._open[key] = subscription
        try:
            subscription.add(wanted, callback)
        except StartError:
            del self._open[key]
            raise
        return subscription

    def leave(self, subscription: TopicSubscription, callback: OnSample | None) -> None:
        """Undo `join`, with the same `callback`."""
        subscription.remove(callback)
        if not subscription.is_used:
            subscription.close()
            if self._open.get(key := (subscription.topic, callback is not None)) is subscription:
                del self._open[key]
            self._closed += 1
            if self._closed == MANY:
                self._returning = self._loop.call_later(RETURN_S, self._return_memory)

    def _return_memory(self) -> None:
        self._closed = 0
        self._loader.submit(return_freed_memory)

    def close(self) -> None:
        if self._returning is not None:
            self._returning.cancel()
        for subscription in self._open.values():
            subscription.close()
        self._open.clear()
        self._loader.shutdown()

    def _ready(self, type_name: str) -> ReadyType:
        if (ready := self._types.get(type_name)) is None:
            ready = self._types[type_name] = self._load(type_name)
        if isinstance(ready, str):
            raise NotInstalledError(ready)
        return ready

    def _load(self, type_name: str) -> ReadyType | str:
        """Load a type, or return why it cannot be received. Usually runs in a thread of its own."""
        try:
            message = self._declared(type_name) or self._topics.installed_type(type_name)
            return ReadyType(message, self._topics.load(type_name, definitions_of(message)))
        except StartError as error:
            return str(error)

    def _declared(self, type_name: str) -> MessageType | None:
        """Return the type as declared by a `.msg` file; None if that cannot be read. The class may then describe it."""
        try:
            return self._interfaces.get(type_name)
        except TableError:
            return None
