"""From a checked route to the Python function that serves it, about one screen long.

The function takes a message and calls what the engine binds for each target NAME: `send_NAME` or `publish_NAME`
and `wanted_NAME`, or `deliver_NAME` where that may be later; `limit_NAME` for a `max_rate`, and `lost_NAME` for
whatever fails. It counts in a flat list. `router explain` prints it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from router.compiler.checked import CheckedCollect, CheckedFeed
from router.compiler.expressions import Typed
from router.compiler.metrics import Counters
from router.compiler.program import TargetPlan
from router.compiler.serving import NamedTarget, ServingSource
from router.compiler.source import Source, namespace_name
from router.compiler.target import Target
from router.table.model import Route
from router.types.protobuf import PayloadCase


class HandlerSource:
    """Generates `def route_NAME(MESSAGE, received_at, now, source)` for one route.

    MESSAGE is `m, datagram` of a route from UDP, `cdr` of one from ROS. With a `ttl` there is one more argument:
    `born`, the arrival by the monotonic clock (ns).
    """

    def __init__(self, route: Route, case: PayloadCase, counters: Counters) -> None:
        self.route = route
        self.counters = counters
        self.span = route.span
        self.function = f"route_{namespace_name(route.name)}"  # a case may be called as a keyword, or as a function
        self.out = Source()
        self._serving = ServingSource(self.out, route, case, counters)

    @property
    def plans(self) -> tuple[TargetPlan, ...]:
        """The targets that the function serves."""
        return tuple(self._serving.plans)

    def inbound(self, targets: Sequence[Target], collect: CheckedCollect | None) -> None:
        """Destinations first: forwarding waits for no mapping. Topics get whole frames where there is a `collect`."""
        named = [self._serving.named(target) for target in targets]
        with self._function("m", "datagram"):
            self._expires()
            if collect is None:
                self._serving.serve(named)
            else:
                self._serving.serve([(name, target) for name, target in named if not target.is_topic])
                topics = [(name, target) for name, target in named if target.is_topic]
                self._collect(collect, topics)
                self._serving.serve(topics)
            if not targets:
                self.out.line("pass", self.span)

    def outbound(self, feed: CheckedFeed) -> None:
        """The message is read once for all destinations. With `for_each` each element is a message of its own."""
        span, one_received = feed.topic.span, self._received(feed, "1")
        named = [self._serving.named(served.target) for served in feed.targets]
        with self._function("cdr"):
            with self.out.block("try:", span):
                feed.reads.write(self.out, span)
                if feed.for_each is not None:
                    self.out.line(f"elements = {self.out.expression(feed.for_each.node)}", feed.for_each.span)
            self._serving.all_lost(named, span, one_received)
            if feed.stamp is not None:
                self._born(feed.stamp)
            self._expires()
            if feed.for_each is None:
                self.out.line(one_received, span)
                self._serving.serve(named, feed.when)
                return
            self.out.line("count = len(elements)", feed.for_each.span)
            self.out.line(self._received(feed, "count"), span)
            with self.out.block("for index, item in enumerate(elements):", feed.for_each.span):
                self._serving.serve(named, feed.when)

    def _received(self, feed: CheckedFeed, messages: str) -> str:
        """The line that counts so many."""
        index = self.counters.index("messages_received", self.route.name, feed.topic.topic.value)
        return f"counts[{index}] += {messages}  # messages_received"

    @contextmanager
    def _function(self, *message: str) -> Iterator[None]:
        parameters = (*message, "received_at", "now", "source", *(["born"] if self.route.ttl else []))
        with self.out.block(f"def {self.function}({', '.join(parameters)}):", self.span):
            yield

    # the age of the message

    def _born(self, stamp: Typed) -> None:
        """The age counts from the stamp where the message has one, else from its arrival."""
        value = self.out.expression(stamp.node)
        with self.out.block(f"if {value}:", stamp.span):
            self.out.line(f"born = min(born, monotonic({value}, received_at, now))", stamp.span)

    def _expires(self) -> None:
        if self.route.ttl:
            self.out.line(f"expires = born + {self.route.ttl.value}", self.route.ttl.span)

    # frames

    def _collect(self, collect: CheckedCollect, topics: Sequence[NamedTarget]) -> None:
        """What follows is for whole frames: `items`, of which `m` is the first."""
        span = collect.span
        for _, target in topics:
            self.counters.index("messages_collected", self.route.name, target.name)
        self.out.line("# collect", span)
        with self.out.block("try:", span):
            collect.reads.write(self.out, span)
            by, count, order = (self.out.expression(typed.node) for typed in (collect.by, collect.count, collect.order))
            self.out.line(f"items = collect(now, (source, {by}), {count}, {order}, m)", span)
        self._serving.all_lost(topics, span)
        with self.out.block("if items is None:", span):
            self.out.line("return", span)
        self.out.line("m, count = items[0], len(items)", span)
