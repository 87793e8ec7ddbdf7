"""Messages from ROS that native threads take and deliver: neither Python nor a publisher can hold them up."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from threading import Lock
from time import sleep
from typing import Protocol

from router import declared as c
from router.carrier.lowered import Routines
from router.carrier.outlets import Outlets
from router.carrier.ring import Ring
from router.carrier.targets import TargetStates, TargetWriter
from router.compiler.lowering import LoweredElements, LoweredFeed
from router.compiler.program import Program, RoutePlan
from router.declared import NONE
from router.threads import StuckError

_IN_TRANSIT_S = 0.01
"""Within this time a message that one of two subscriptions has got reaches the other one as well."""


class Subscription(Protocol):
    """What `ros.receiving.RawSubscription` is. A message is taken by one thread alone."""

    @property
    def address(self) -> int: ...

    @property
    def capacity(self) -> int: ...

    def announce_to(self, eventfd: int | None) -> None: ...

    def take_all(self) -> Sequence[object]: ...


@dataclass(slots=True)
class NativeFromRos:
    """The routes of each topic, an array of `struct ros_route`, with all that they refer to.

    `urgent` are the topics that an urgent route takes messages from.
    """

    topics: dict[str, ctypes.Array[c.RosRoute]] = field(default_factory=dict)
    urgent: set[str] = field(default_factory=set)
    arrays: list[object] = field(default_factory=list)
    states: TargetStates = field(default_factory=TargetStates)

    def only(self, *, urgent: bool) -> NativeFromRos:
        """Those for the thread of urgent messages, or those for the other one."""
        topics = {topic: routes for topic, routes in self.topics.items() if (topic in self.urgent) is urgent}
        return NativeFromRos(topics, self.urgent, self.arrays)


def native_from_ros(program: Program, generation: int, outlets: Outlets) -> NativeFromRos:
    """Make the arrays of all topics that the carrier takes. `outlets` serve the targets of routes from ROS, too."""
    made = NativeFromRos()
    made.arrays.append(made.states)
    writer = TargetWriter(program, outlets, generation, made.arrays, made.states)
    for topic, feeds in program.lowered.from_ros.items():
        plans = {plan.route: plan for plan in program.outbound[topic]}
        routes = [_route(writer, plans[feed.route], feed) for feed in feeds]
        made.topics[topic] = (c.RosRoute * len(routes))(*routes)
        if any(feed.is_urgent for feed in feeds):
            made.urgent.add(topic)
    return made


def _route(writer: TargetWriter, plan: RoutePlan, feed: LoweredFeed) -> c.RosRoute:
    assert plan.topic is not None  # noqa: S101 - of a route from ROS
    counters, routines = writer.program.counters, Routines(feed.layout, writer.arrays)
    targets = writer.targets(plan, plan.targets, feed.targets, routines)
    for_each = native_for_each(feed.for_each, routines)
    targets.layout = routines.layout()
    seconds, nanoseconds = feed.stamp or (NONE, NONE)
    return c.RosRoute(
        targets=targets,
        for_each=for_each,
        seconds=seconds,
        nanoseconds=nanoseconds,
        received=counters.index("messages_received", plan.route, plan.topic),
        last_message=counters.index("route_last_message_timestamp_seconds", plan.route),
        duration=counters.index("route_duration_seconds", plan.route),
    )


def native_for_each(elements: LoweredElements | None, routines: Routines) -> c.ForEach:
    """`for_each` of a route, None without."""
    if elements is None:
        return c.ForEach()
    return c.ForEach(
        list=routines.routine(elements.routine),
        stored=elements.scalar,
        section=elements.section,
        item=elements.item,
        index=elements.index,
        count=elements.count,
    )


@dataclass(frozen=True, slots=True)
class _Served:
    """What the thread serves, and the eventfd of each subscription. `structure` refers to `topics`."""

    messages: NativeFromRos
    subscriptions: Mapping[str, Subscription]
    eventfds: Mapping[Subscription, int]
    topics: ctypes.Array[c.RosTopic]
    structure: c.RosSet


class FromRosThread:
    """Takes the messages of subscriptions, and sends what routes make of them. It starts at once, and stops once.

    `deadmen` is the address of the carrier's, `counters` the array that the thread counts in. `take` and `reset` are
    addresses of functions: those of `ros.receiving`. A thread for urgent messages runs before others.
    """

    def __init__(
        self,
        library: ctypes.CDLL,
        deadmen: int,
        counters: ctypes.Array[ctypes.c_int64],
        events: Ring,
        take: int,
        reset: int,
        *,
        is_urgent: bool = True,
    ) -> None:
        """Raises MemoryError, also for a lack of descriptors or threads."""
        self._library = library
        self._counters, self._events = counters, events
        self._served: _Served | None = None
        self._in_use = Lock()  # for those who read counters while the thread may be stopped
        self._address: int = library.from_ros_open(deadmen, counters, events.address, take, reset, is_urgent)
        if not self._address:
            raise MemoryError("the thread for messages from ROS cannot be started")

    @property
    def failures(self) -> int:
        """How often the middleware refused to hand out a message."""
        with self._in_use:
            return int(self._library.from_ros_failures(self._address)) if self._address else 0

    def counters(self, count: int) -> list[int]:
        """Return the first counters, as they are between two messages."""
        copy = (ctypes.c_int64 * count)()
        with self._in_use:
            if not self._address:
                return list(self._counters[:count])
            self._library.from_ros_counters(self._address, copy, count)
        return list(copy)

    def serve(self, messages: NativeFromRos, subscriptions: Mapping[str, Subscription]) -> None:
        """Serve the topics of `messages` from these subscriptions, and no others: between two messages.

        What has arrived on subscriptions that are left is served before; they may be closed afterwards. Raises
        StuckError after 1 s, OSError or one of `ros.node.RCL_ERRORS`, with nothing changed.
        """
        earlier = self._served
        eventfds = dict(earlier.eventfds) if earlier else {}
        with ExitStack() as adding:
            for subscription in subscriptions.values():
                if subscription not in eventfds:
                    eventfds[subscription] = eventfd = self._watched(subscription)
                    adding.callback(self._leave, subscription, eventfd)
            if earlier:
                forget_what_is_served(earlier.subscriptions, subscriptions)
            served = _served(messages, subscriptions, {each: eventfds[each] for each in subscriptions.values()})
            if not self._library.from_ros_serve(self._address, ctypes.byref(served.structure)):
                raise StuckError("the thread for messages from ROS is stuck in the middleware: try again")
            adding.pop_all()
        self._served = served
        for subscription in eventfds.keys() - served.eventfds.keys():
            self._leave(subscription, eventfds[subscription])

    def follow(self, other: FromRosThread) -> None:
        """Go on where another thread has left subscriptions: what it has served is not served again."""
        with self._in_use:
            if self._address and other._address:
                self._library.from_ros_follow(self._address, other._address)

    def stop(self) -> bool:
        """Serve what has arrived, and end.

        Return False if the thread is stuck in the middleware after 1 s: then it is left, and the subscriptions must
        stay open. It feeds and sends nothing any more. Idempotent.
        """
        with self._in_use:
            address, self._address = self._address, 0
        if not address:
            return self not in _left
        if not self._library.from_ros_stop(address):
            _left.append(self)
            return False
        for subscription, eventfd in (self._served.eventfds if self._served else {}).items():
            subscription.announce_to(None)
            os.close(eventfd)
        return True

    def _watched(self, subscription: Subscription) -> int:
        """Return the eventfd by which the thread learns of new messages."""
        with ExitStack() as opening:
            eventfd = os.eventfd(0, os.EFD_CLOEXEC)
            opening.callback(os.close, eventfd)
            if error := self._library.from_ros_watch(self._address, eventfd):
                raise OSError(error, os.strerror(error))
            opening.callback(self._library.from_ros_unwatch, self._address, eventfd)
            subscription.announce_to(eventfd)
            opening.pop_all()
        return eventfd

    def _leave(self, subscription: Subscription, eventfd: int) -> None:
        subscription.announce_to(None)
        self._library.from_ros_unwatch(self._address, eventfd)
        os.close(eventfd)


_left: list[FromRosThread] = []
"""Those that are stuck: what they refer to has to live until the process ends."""


def _served(
    messages: NativeFromRos, subscriptions: Mapping[str, Subscription], eventfds: Mapping[Subscription, int]
) -> _Served:
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
    return _Served(messages, subscriptions, eventfds, array, c.RosSet(topics=array, count=len(topics)))


def forget_what_is_served(earlier: Mapping[str, Subscription], later: Mapping[str, Subscription]) -> None:
    """Take from subscriptions that replace others what the earlier ones have got as well, and serve."""
    replacing = [each for topic, each in later.items() if earlier.get(topic, each) is not each]
    for subscription in replacing:
        subscription.take_all()
    if replacing:
        sleep(_IN_TRANSIT_S)
