"""Messages from ROS: what a program makes of them, and the two threads that take them, from one program to the next."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from dataclasses import dataclass

from router.carrier.from_ros import FromRosThread, NativeFromRos, Subscription, forget_what_is_served
from router.carrier.ring import Ring
from router.errors import StartError
from router.log import logger
from router.threads import StuckError


@dataclass(frozen=True, slots=True)
class RosTopics:
    """What a program makes of messages from ROS, and all of its subscriptions by topic."""

    messages: NativeFromRos
    subscriptions: Mapping[str, Subscription]

    def only(self, *, urgent: bool) -> RosTopics:
        """With those for the thread of urgent messages, or those for the other one."""
        return RosTopics(self.messages.only(urgent=urgent), self.subscriptions)


class FromRos:
    """One of the threads, which starts with the first program that has messages for it.

    `deadmen` is the address of the carrier's, `counts` the array that the thread counts in. Urgent messages have a
    thread of their own.
    """

    def __init__(
        self,
        library: ctypes.CDLL,
        deadmen: int,
        counts: ctypes.Array[ctypes.c_int64],
        events: Ring,
        *,
        is_urgent: bool,
    ) -> None:
        self._library = library
        self.is_urgent = is_urgent
        self._deadmen = deadmen
        self._counts = counts
        self._events = events
        self._thread: FromRosThread | None = None
        self._served = RosTopics(NativeFromRos(), {})
        self._refused = 0
        self.has_passed = True
        """Whether the thread serves what it was last told to serve."""

    def counters(self, count: int) -> list[int]:
        """Return the first counters, as they are between two messages."""
        return self._thread.counters(count) if self._thread else list(self._counts[:count])

    def open(self, messages: NativeFromRos) -> None:
        """Start the thread if these need it. Raises StartError."""
        if self._thread is not None or not messages.only(urgent=self.is_urgent).topics:
            return
        from router.ros.receiving import RESET, TAKE  # rclpy is there: the topics are open

        try:
            self._thread = FromRosThread(
                self._library, self._deadmen, self._counts, self._events, TAKE, RESET, is_urgent=self.is_urgent
            )
        except MemoryError as error:
            raise StartError(str(error)) from error

    def leave(self, next_one: RosTopics) -> None:
        """Cease to serve topics that the other thread is to serve, once what has arrived on them is served.

        Raises StuckError, with nothing changed, also where there are none.
        """
        if self._thread is None:
            return
        now, then = self._served, next_one.only(urgent=not self.is_urgent).messages.topics
        moved = {topic: next_one.subscriptions[topic] for topic in now.messages.topics if topic in then}
        forget_what_is_served(now.subscriptions, moved)
        kept = {topic: routes for topic, routes in now.messages.topics.items() if topic not in moved}
        messages = NativeFromRos(kept, now.messages.urgent, now.messages.arrays)
        self._thread.serve(messages, {topic: now.subscriptions[topic] for topic in kept})

    def follow(self, other: FromRos) -> None:
        """Go on where the other thread has left topics."""
        if self._thread is not None and other._thread is not None:
            self._thread.follow(other._thread)

    def stay(self) -> None:
        """Undo `leave`."""
        self.serve(self._served)

    def serve(self, next_one: RosTopics) -> None:
        """Serve other topics, or by another program. What fails is logged; what was served before is served then."""
        if self._thread is None:
            return
        next_one = next_one.only(urgent=self.is_urgent)
        try:
            messages, subscriptions = next_one.messages, next_one.subscriptions
            self._thread.serve(messages, {topic: subscriptions[topic] for topic in messages.topics})
        except (StuckError, OSError, RuntimeError) as error:  # those of rcl are RuntimeErrors
            logger.error("messages from ROS are not served as the table says until it is reloaded", why=str(error))
            self.has_passed = False
        else:
            self._served = next_one
            self.has_passed = True

    def report_failures(self) -> None:
        """Log how often the middleware has refused to hand out a message since the last call."""
        refused = self._thread.failures if self._thread else 0
        if refused > self._refused:
            logger.error("the middleware has not handed out messages that it has", times=refused - self._refused)
        self._refused = refused

    def stop(self) -> bool:
        """Serve what has arrived, and end. Return False if the thread is stuck: subscriptions must stay open then.

        Idempotent.
        """
        has_ended = self._thread is None or self._thread.stop()
        if not has_ended:
            logger.error("a thread for messages from ROS is stuck, and the router ends without it")
        return has_ended
