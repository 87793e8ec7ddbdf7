"""The native threads for messages from ROS, which neither Python nor a publisher can block."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from time import sleep

from router import declared as c
from router.carrier.ring import Ring
from router.carrier.ros_routes import RosRoutes, Subscription
from router.carrier.threads import NativeThread
from router.errors import StartError
from router.log import logger
from router.threads import StuckError

_IN_TRANSIT_S = 0.01
"""Within this time, a message that has reached one of two subscriptions also reaches the other."""


@dataclass(frozen=True, slots=True)
class _TopicSet:
    """The topics that the thread serves, and the eventfd of each subscription. `structure` points into `topics`."""

    messages: RosRoutes
    eventfds: Mapping[Subscription, int]
    topics: ctypes.Array[c.RosTopic]
    structure: c.RosSet

    @property
    def subscriptions(self) -> Mapping[str, Subscription]:
        return {topic: self.messages.subscriptions[topic] for topic in self.messages.topics}


class FromRosThread(NativeThread):
    """Takes the messages of subscriptions and executes their routes. It starts once and stops once.

    `deadmen` is the address of the carrier's deadmen. The thread for urgent messages has priority over others. A thread
    that was not started serves nothing.
    """

    def __init__(
        self,
        library: ctypes.CDLL,
        deadmen: int,
        counts: ctypes.Array[ctypes.c_int64],
        events: Ring,
        *,
        is_urgent: bool = True,
    ) -> None:
        super().__init__(library, counts, events, library.from_ros_counters)
        self.name = "ros urgent" if is_urgent else "ros messages"
        self.is_urgent = is_urgent
        self.has_adopted = True
        """Whether the thread serves the topics that it was last given."""
        self._deadmen = deadmen
        self._adopted = RosRoutes()
        self._served = _topic_set(RosRoutes(), {})
        self._reported = 0

    def start(self, take: int, reset: int) -> None:
        """Start the thread if it is not running. `take` and `reset` are function addresses, as in `ros.receiving`.

        Raises StartError if memory, descriptors or threads run out.
        """
        if self._address:
            return
        arguments = self._deadmen, self.counts, self.events.address, take, reset, self.is_urgent
        self._address = int(self._library.from_ros_open(*arguments) or 0)
        if not self._address:
            raise StartError("the thread for messages from ROS cannot be started")

    @property
    def failures(self) -> int:
        """How often the middleware failed to deliver a message."""
        with self._in_use:
            return int(self._library.from_ros_failures(self._address)) if self._address else 0

    def report_failures(self) -> None:
        """Log how often the middleware failed to deliver a message since the last call."""
        failures = self.failures
        if failures > self._reported:
            logger.error(
                "the middleware failed to hand over messages that it has received", times=failures - self._reported
            )
        self._reported = failures

    def hand_over(self, messages: RosRoutes) -> None:
        """Stop serving the topics that `messages` assign to the other thread, after handling what has arrived on them.

        Raises StuckError with nothing changed, even if there is no such topic.
        """
        then, now = messages.only(urgent=not self.is_urgent), self._adopted
        moved = now.topics.keys() & then.topics.keys()
        if self._address:
            drop_duplicates(now.subscriptions, {topic: then.subscriptions[topic] for topic in moved})
            self.serve(now.without(moved))

    def take_back(self) -> None:
        """Undo `hand_over`."""
        self.adopt(self._adopted)

    def adopt(self, messages: RosRoutes) -> None:
        """Serve this thread's messages of another program. If that fails, keep serving the earlier ones."""
        messages = messages.only(urgent=self.is_urgent)
        try:
            self.serve(messages)
        except (StuckError, OSError, RuntimeError) as error:  # errors of rcl are RuntimeErrors
            logger.error("messages from ROS are still routed by the old table; reload the table again", why=str(error))
            self.has_adopted = False
        else:
            self._adopted = messages
            self.has_adopted = True

    def serve(self, messages: RosRoutes) -> None:
        """Switch to the topics of `messages` between two messages.

        Messages that have arrived on other subscriptions are handled first; these may be closed afterwards. Raises
        StuckError after 1 s, OSError or one of `ros.node.RCL_ERRORS`, with nothing changed.
        """
        if not self._address:
            return
        earlier, eventfds = self._served, dict(self._served.eventfds)
        subscriptions = {topic: messages.subscriptions[topic] for topic in messages.topics}
        with ExitStack() as adding:
            for subscription in subscriptions.values():
                if subscription not in eventfds:
                    eventfds[subscription] = eventfd = self._watch(subscription)
                    adding.callback(self._unwatch, subscription, eventfd)
            drop_duplicates(earlier.subscriptions, subscriptions)
            served = _topic_set(messages, {each: eventfds[each] for each in subscriptions.values()})
            if not self._library.from_ros_serve(self._address, ctypes.byref(served.structure)):
                raise StuckError("the thread for messages from ROS is stuck in the middleware: try again")
            adding.pop_all()
        self._served = served
        for subscription in eventfds.keys() - served.eventfds.keys():
            self._unwatch(subscription, eventfds[subscription])

    def follow(self, other: FromRosThread) -> None:
        """Take over the positions of another thread in its subscriptions, so that no message is handled twice."""
        with self._in_use:
            if self._address and other._address:
                self._library.from_ros_follow(self._address, other._address)

    def stop(self) -> bool:
        """Handle what has arrived, and end the thread.

        Return False if it is stuck in the middleware after 1 s: then it keeps running, but feeds and sends nothing, and
        the subscriptions must stay open. Idempotent.
        """
        with self._in_use:
            address, self._address = self._address, 0
        if not address:
            return self not in _stuck
        if not self._library.from_ros_stop(address):
            _stuck.append(self)
            return False
        for subscription, eventfd in self._served.eventfds.items():
            subscription.announce_to(None)
            os.close(eventfd)
        return True

    def _watch(self, subscription: Subscription) -> int:
        """Return the eventfd that announces new messages to the thread. Raises OSError."""
        with ExitStack() as opening:
            eventfd = os.eventfd(0, os.EFD_CLOEXEC)
            opening.callback(os.close, eventfd)
            if error := self._library.from_ros_watch(self._address, eventfd):
                raise OSError(error, os.strerror(error))
            opening.callback(self._library.from_ros_unwatch, self._address, eventfd)
            subscription.announce_to(eventfd)
            opening.pop_all()
        return eventfd

    def _unwatch(self, subscription: Subscription, eventfd: int) -> None:
        subscription.announce_to(None)
        self._library.from_ros_unwatch(self._address, eventfd)
        os.close(eventfd)


_stuck: list[FromRosThread] = []
"""Stuck threads: what they use must live until the process ends."""


def _topic_set(messages: RosRoutes, eventfds: Mapping[Subscription, int]) -> _TopicSet:
    subscriptions = messages.subscriptions
    topics = [
        c.RosTopic(
            subscription=subscriptions[topic].address,
            routes=routes,
            route_count=len(routes),
            capacity=subscriptions[topic].capacity,
            eventfd=eventfds[subscriptions[topic]],
        )
        for topic, routes in messages.topics.items()
    ]
    array = (c.RosTopic * len(topics))(*topics)
    return _TopicSet(messages, eventfds, array, c.RosSet(topics=array, count=len(topics)))


def drop_duplicates(earlier: Mapping[str, Subscription], later: Mapping[str, Subscription]) -> None:
    """Drop messages of new subscriptions that the replaced ones have also received and will serve."""
    replacing = [each for topic, each in later.items() if earlier.get(topic, each) is not each]
    for subscription in replacing:
        subscription.take_all()
    if replacing:
        sleep(_IN_TRANSIT_S)
