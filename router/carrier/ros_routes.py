"""Routes from ROS as the carrier executes them: `native/route_ros.h`."""

from __future__ import annotations

import ctypes
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Protocol

from router import declared as c
from router.carrier.outlets import Outlets
from router.carrier.targets import TargetStates, TargetWriter
from router.compiler.lowering import LoweredElements, LoweredFeed
from router.compiler.lowering.arrays import Arrays
from router.compiler.lowering.routines import Routines
from router.compiler.program import Program, RoutePlan
from router.declared import NONE


class Subscription(Protocol):
    """The protocol of `ros.receiving.RawSubscription`. Only one thread takes its messages."""

    @property
    def address(self) -> int: ...

    @property
    def capacity(self) -> int: ...

    def announce_to(self, eventfd: int | None) -> None: ...

    def take_all(self) -> Sequence[object]: ...


@dataclass(slots=True)
class NativeFromRos:
    """The routes of each topic, an array of `struct ros_route`, with everything that they point to.

    `urgent` are the topics with an urgent route; `subscriptions` has the subscriptions of all topics.
    """

    topics: dict[str, ctypes.Array[c.RosRoute]] = field(default_factory=dict)
    urgent: set[str] = field(default_factory=set)
    arrays: Arrays = field(default_factory=Arrays)
    states: TargetStates = field(default_factory=TargetStates)
    subscriptions: Mapping[str, Subscription] = field(default_factory=dict)

    def only(self, *, urgent: bool) -> NativeFromRos:
        """Return the part for the thread of urgent messages, or for the other thread."""
        return self.without({topic for topic in self.topics if (topic in self.urgent) is not urgent})

    def without(self, topics: Container[str]) -> NativeFromRos:
        return replace(self, topics={topic: routes for topic, routes in self.topics.items() if topic not in topics})


def native_from_ros(
    program: Program,
    generation: int,
    outlets: Outlets,
    subscriptions: Mapping[str, Subscription] = MappingProxyType({}),
) -> NativeFromRos:
    """Make the arrays of all routes from ROS. `subscriptions` are by topic."""
    made = NativeFromRos(subscriptions=subscriptions)
    made.arrays.keep(made.states)
    if outlets.boards is not None:
        made.arrays.include(outlets.boards.arrays)
    writer = TargetWriter(program, outlets, generation, made.arrays, made.states)
    for topic, feeds in program.lowered.from_ros.items():
        plans = {plan.route: plan for plan in program.outbound[topic]}
        routes = [_route(writer, plans[feed.route], feed) for feed in feeds]
        made.topics[topic] = made.arrays.array(c.RosRoute, routes)
        if any(feed.is_urgent for feed in feeds):
            made.urgent.add(topic)
    return made


def _route(writer: TargetWriter, plan: RoutePlan, feed: LoweredFeed) -> c.RosRoute:
    assert plan.topic is not None  # noqa: S101 - a route from ROS has a topic
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
        last_message=counters.index("route_silence_seconds", plan.route),
        duration=counters.index("route_duration_seconds", plan.route),
    )


def native_for_each(elements: LoweredElements | None, routines: Routines) -> c.ForEach:
    """Make the `for_each` of a route; empty if it has none."""
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
