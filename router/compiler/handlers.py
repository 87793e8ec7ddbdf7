"""From a checked route to the Python function that serves it, about one screen long.

The function takes a message and calls what the engine binds for each target NAME: `send_NAME` or `publish_NAME`
and `wanted_NAME`, or `deliver_NAME` where that may be later; `limit_NAME` for a `max_rate`, and `lost_NAME` for
whatever fails. It counts in a flat list. `router explain` prints it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

from router.compiler.cdr import write_message
from router.compiler.checked import CheckedCollect, CheckedFeed, CheckedTarget
from router.compiler.expressions import Typed
from router.compiler.metrics import DROP_REASONS, Counters
from router.compiler.payload import write_envelope
from router.compiler.program import TargetPlan
from router.compiler.source import Source, namespace_name
from router.errors import SourceSpan
from router.table.model import Keep, Route
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

    def inbound(self, targets: Sequence[CheckedTarget], collect: CheckedCollect | None) -> None:
        """Destinations first: forwarding waits for no mapping. Topics get whole frames where there is a `collect`."""
        named = [self._serving.named(target) for target in targets]
        with self._function("m", "datagram"):
            self._expires()
            if collect is None:
                self._serving.serve(named)
            else:
                self._serving.serve([(name, target) for name, target in named if not target.topic])
                topics = [(name, target) for name, target in named if target.topic]
                self._collect(collect, topics)
                self._serving.serve(topics)
            if not targets:
                self.out.line("pass", self.span)

    def outbound(self, feed: CheckedFeed) -> None:
        """The message is read once for all destinations. With `for_each` each element is a message of its own."""
        span, one_received = feed.topic.span, self._received(feed, "1")
        named = [self._serving.named(target) for target in feed.targets]
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
            self.counters.index("messages_collected", self.route.name, target.label)
        self.out.line("# collect", span)
        with self.out.block("try:", span):
            collect.reads.write(self.out, span)
            by, count, order = (self.out.expression(typed.node) for typed in (collect.by, collect.count, collect.order))
            self.out.line(f"items = collect(now, (source, {by}), {count}, {order}, m)", span)
        self._serving.all_lost(topics, span)
        with self.out.block("if items is None:", span):
            self.out.line("return", span)
        self.out.line("m, count = items[0], len(items)", span)


NamedTarget = tuple[str, CheckedTarget]
"""A target with its part of the Python names."""


@dataclass(slots=True)
class ServingSource:
    """Appends to `out` what serves targets of `route`. `plans` are those that were named so far."""

    out: Source
    route: Route
    case: PayloadCase
    counters: Counters
    plans: list[TargetPlan] = field(default_factory=list)

    def named(self, target: CheckedTarget) -> NamedTarget:
        """Opens the target's series, which all exist from the start."""
        for reason in DROP_REASONS:
            self.counters.index("messages_dropped", self.route.name, target.label, reason)
        self.counters.index("messages_filtered", self.route.name, target.label)
        delivered = ("messages_published",) if target.topic else ("datagrams_sent", "sent_bytes")
        for metric in delivered:
            self.counters.index(metric, self.route.name, target.label)
        name = self._unique(namespace_name(target.label))
        self.plans.append(
            TargetPlan(
                name=name,
                target=target.label,
                is_topic=target.topic is not None,
                max_rate=target.declared.max_rate,
                keep=target.declared.keep,
                priority=target.priority,
                is_deferred=target.is_deferred,
                deadmen=target.deadmen,
            )
        )
        return name, target

    def _unique(self, base: str) -> str:
        """`a/b` and `a_b` are different topics but would be one Python name."""
        taken = {plan.name for plan in self.plans}
        candidates = (f"{base}_{number}" if number > 1 else base for number in itertools.count(1))
        return next(name for name in candidates if name not in taken)

    def serve(self, targets: Sequence[NamedTarget], when: Typed | None = None) -> None:
        """`when` holds for all of them, beside what each has."""
        for name, target in targets:
            self.out.line(f"# {'topic' if target.topic else 'destination'} {target.label}", target.span)
            conditions = [condition for condition in (when, target.when) if condition is not None]
            if not target.topic:
                self._guarded(name, target, conditions, self._deliver if target.is_deferred else self._send)
                continue
            with self.out.block(f"if wanted_{name}[0]:", target.span):
                self._guarded(name, target, conditions, self._deliver if target.is_deferred else self._publish)
            with self.out.block("else:", target.span):
                self._count("messages_filtered", target)

    def all_lost(self, targets: Sequence[NamedTarget], span: SourceSpan, *before: str) -> None:
        """Ends a `try:` without which no target can be served. The lines `before` come before the losses."""
        with self.out.block("except FAILURES as error:", span):
            for line in before:
                self.out.line(line, span)
            for name, _ in targets:
                self.out.line(f"lost_{name}(error)", span)
            self.out.line("return", span)

    def _guarded(
        self, name: str, target: CheckedTarget, conditions: Sequence[Typed], serve: Callable[[str, CheckedTarget], None]
    ) -> None:
        """What fails for one target is counted there and leaves the others alone."""
        with self.out.block("try:", target.span):
            if target.reads is not None:
                target.reads.write(self.out, target.span)
            self._conditional(name, target, conditions, serve)
        with self.out.block("except FAILURES as error:", target.span):
            self.out.line(f"lost_{name}(error)", target.span)

    def _conditional(
        self, name: str, target: CheckedTarget, conditions: Sequence[Typed], serve: Callable[[str, CheckedTarget], None]
    ) -> None:
        """Serves the target if each `when` is true, the message is fresh, and its `max_rate` is not used up."""
        word = "if"
        for condition in conditions:
            with self.out.block(f"{word} not {self.out.expression(condition.node)}:", condition.span):
                self._count("messages_filtered", target)
            word = "elif"
        if self.route.ttl:
            with self.out.block(f"{word} clock_ns() > expires:", self.route.ttl.span):
                self._count("messages_dropped", target, "stale")
            word = "elif"
        if target.declared.max_rate is not None and target.declared.keep is Keep.FIRST:
            with self.out.block(f"{word} not limit_{name}(now):", target.span):
                self._count("messages_dropped", target, "rate_limited")
            word = "elif"
        if word == "if":
            serve(name, target)
            return
        with self.out.block("else:", target.span):
            serve(name, target)

    def _count(self, metric: str, target: CheckedTarget, *reason: str) -> None:
        index = self.counters.index(metric, self.route.name, target.label, *reason)
        self.out.line(f"counts[{index}] += 1  # {' '.join((metric, *reason))}", target.span)

    def _data(self, name: str, target: CheckedTarget) -> str:
        """Appends what makes the bytes for a target, and returns the expression that is them."""
        if target.plan is None:
            data = "datagram"
        elif target.topic:
            return write_message(self.out, target.plan, name)
        else:
            data = write_envelope(self.out, target.plan, self.case, name)
        return f"{data}.rstrip(ZERO)" if target.endpoint is not None and target.endpoint.trim_trailing_zeros else data

    def _send(self, name: str, target: CheckedTarget) -> None:
        data = self._data(name, target)
        if target.deadmen:  # before the command is sent, so that nothing which a deadman sends can follow it
            self.out.line(f"feed_{name}(now)", target.span)
        index = self.counters.index("sent_bytes", self.route.name, target.label)
        self.out.line(f"counts[{index}] += send_{name}({data})  # sent_bytes", target.span)
        self._count("datagrams_sent", target)

    def _publish(self, name: str, target: CheckedTarget) -> None:
        self.out.line(f"publish_{name}({self._data(name, target)})", target.span)
        self._count("messages_published", target)

    def _deliver(self, name: str, target: CheckedTarget) -> None:
        """Sent or published now or later; counted there, and deadmen are told there."""
        data = self._data(name, target)
        expires = "expires" if self.route.ttl else "None"
        self.out.line(f"deliver_{name}(now, {data}, {expires})", target.span)
