"""From a checked route to the Python function that serves it, which is about one screen long.

The function takes a message and calls what the engine binds for each target NAME: `send_NAME` or `publish_NAME`
and `wanted_NAME`, or `deliver_NAME` where that may be later; `limit_NAME` for a `max_rate`, and `lost_NAME` for
whatever fails. With a `ttl` or deadmen, `send_NAME` is told when the message expires, checks that again and feeds
the deadmen. It counts in a flat list.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import count
from pathlib import Path
from types import CodeType

from router.compiler.cdr import CdrReads, write_message
from router.compiler.check import Checked, check_table
from router.compiler.checked import CheckedCollect, CheckedRoute, CheckedSubscription, CheckedTarget
from router.compiler.expressions.tree import Node, paths_in
from router.compiler.lookup import Definitions
from router.compiler.metrics import Counters
from router.compiler.namespace import NAMESPACE
from router.compiler.plan import expressions
from router.compiler.program import Program, RoutePlan
from router.compiler.python import NO_VALUES, Values, render
from router.compiler.source import Source, namespace_name
from router.errors import SourceSpan
from router.table.model import OnLimit, Route
from router.types.protobuf import PayloadCase
from tests.oracles.python_engine.payload import write_envelope

Deliver = Callable[[str, CheckedTarget], None]
"""Appends the lines that hand the message to a target."""

NamedTarget = tuple[str, CheckedTarget]
"""A target with its part of the Python names, one of `identifiers`."""

_EXPIRY = {True: "command_expires", False: "expires"}
"""The names of the time after which a message is stale, by whether the target is a board."""


_checked: dict[tuple[Path, str], Sequence[CheckedRoute]] = {}
"""The routes of tables, by path and checksum."""


def remember(checked: Checked) -> None:
    """Have `generated` find the routes of the table, whatever becomes of its file."""
    if checked.table is not None:
        _checked[checked.table.path, checked.table.sha256] = checked.routes


@dataclass(frozen=True)
class Generated:
    """The source of a function, its name, and the file that its tracebacks name."""

    source: Source
    function: str
    file: str

    @cached_property
    def code(self) -> CodeType:
        return self.source.compile(self.file)

    @property
    def constants(self) -> Mapping[str, object]:
        return {**NAMESPACE, **self.source.constants}


def generated(program: Program, handler: RoutePlan) -> Generated:
    """The function that serves all targets of a handler."""
    checked = next(each for each in _routes(program) if each.route.name == handler.route)
    feed = next((each for each in checked.subscriptions if each.topic.topic.value == handler.topic), None)
    targets = feed.targets if feed else checked.targets
    named = list(zip(identifiers(handler), targets, strict=True))
    generator = HandlerSource(checked.route, checked.case, program.counters)
    if feed:
        generator.outbound(feed, named)
    else:
        generator.inbound(named, checked.collect)
    places = [feed.topic.span] if feed else [target.span for target in targets if target.topic] or [checked.route.span]
    return Generated(generator.out, function_name(checked.route), places[0].file)


def _routes(program: Program) -> Sequence[CheckedRoute]:
    key = program.table.path, program.table.sha256
    if key not in _checked:
        checked = check_table(program.table.path, {}, Definitions(program.protos))
        assert checked.table is not None
        assert checked.table.sha256 == program.table.sha256
        remember(checked)
    return _checked[key]


def identifiers(handler: RoutePlan) -> list[str]:
    """A Python name for each target, which no other one has: `a/b` and `a_b` are different topics."""
    made: list[str] = []
    for target in handler.targets:
        base = namespace_name(target.label)
        candidates = (f"{base}_{number}" if number > 1 else base for number in count(1))
        made.append(next(name for name in candidates if name not in made))
    return made


def function_name(route: Route) -> str:
    return f"route_{namespace_name(route.name)}"  # a case may be called as a keyword, or as a function


def _reads(subscription: CheckedSubscription) -> CdrReads:
    """What the expressions of a subscription read."""
    nodes = [subscription.for_each, subscription.stamp, subscription.when]
    for target in subscription.targets:
        nodes += [target.when, *(expressions(target.plan) if target.plan is not None else ())]
    return CdrReads(subscription.type, (path for node in nodes if node is not None for path in paths_in(node)))


class HandlerSource:
    """The source of `def route_NAME(MESSAGE, received_at, now, source)` for one route, with the targets that it serves.

    MESSAGE is `m, datagram` of a route from UDP, `cdr` of one from ROS. With a `ttl` there is one more argument:
    `born`, the arrival by the boot clock (freshness.Born).
    """

    def __init__(self, route: Route, case: PayloadCase, counters: Counters) -> None:
        self.route = route
        self.case = case
        self.counters = counters
        self.out = Source()
        self.values: Values = NO_VALUES

    def inbound(self, named: Sequence[NamedTarget], collect: CheckedCollect | None) -> None:
        """Destinations come first, so that forwarding waits for no mapping. With `collect`, topics get whole frames."""
        topics = [(name, target) for name, target in named if target.topic]
        with self._function("m", "datagram"):
            self._expires(named)
            if collect is None or not topics:
                self._serve(named)
            else:
                self._serve([(name, target) for name, target in named if not target.topic])
                self._collect(collect, topics)
                self._serve(topics)
            if not named:
                self.out.line("pass", self.route.span)

    def outbound(self, subscription: CheckedSubscription, named: Sequence[NamedTarget]) -> None:
        """The message is read once for all destinations. With `for_each`, each element is served as a message."""
        span, for_each = subscription.topic.span, subscription.for_each
        one_received = self._received(subscription, "1")
        reads = _reads(subscription)
        self.values = reads.values
        with self._function("cdr"):
            with self.out.block("try:", span):
                reads.write(self.out, span)
                if for_each is not None:
                    self.out.line(f"elements = {self._expression(for_each)}", for_each.span)
            self._all_lost(named, span, one_received)
            if subscription.stamp is not None:
                self._born(subscription.stamp)
            self._expires(named)
            if for_each is None:
                self.out.line(one_received, span)
                self._serve(named, subscription.when)
                return
            self.out.line("count = len(elements)", for_each.span)
            self.out.line(self._received(subscription, "count"), span)
            with self.out.block("for index, item in enumerate(elements):", for_each.span):
                self._serve(named, subscription.when)

    def _received(self, subscription: CheckedSubscription, messages: str) -> str:
        """Return the line that counts so many messages."""
        index = self.counters.index("messages_received", self.route.name, subscription.topic.topic.value)
        return f"counts[{index}] += {messages}  # messages_received"

    @contextmanager
    def _function(self, *message: str) -> Iterator[None]:
        parameters = (*message, "received_at", "now", "source", *(["born"] if self.route.ttl else []))
        with self.out.block(f"def {function_name(self.route)}({', '.join(parameters)}):", self.route.span):
            yield

    def _expression(self, node: Node) -> str:
        return self.out.expression(render(node, self.values))

    # the age of the message

    def _born(self, stamp: Node) -> None:
        """The age counts from the stamp where the message has one, else from its arrival."""
        value = self._expression(stamp)
        with self.out.block(f"if {value}:", stamp.span):
            self.out.line(f"born = born.or_before(stamped({value}, received_at, now))", stamp.span)

    def _expires(self, targets: Iterable[NamedTarget]) -> None:
        """Commands to boards are as old as they can be, anything else is as young."""
        if not self.route.ttl:
            return
        for is_board, reading in ((True, "oldest"), (False, "youngest")):
            if any(target.is_board is is_board for _, target in targets):
                line = f"{_EXPIRY[is_board]} = born.{reading} + {self.route.ttl.value}"
                self.out.line(line, self.route.ttl.span)

    def _expiry(self, target: CheckedTarget) -> str:
        return _EXPIRY[target.is_board] if self.route.ttl else "None"

    # frames

    def _collect(self, collect: CheckedCollect, topics: Sequence[NamedTarget]) -> None:
        """Append the lines that return unless a frame is complete. `items` are its parts, `m` is the first of them."""
        span = collect.span
        self.out.line("# collect", span)
        with self.out.block("try:", span):
            by, count, order = map(self._expression, (collect.by, collect.count, collect.order))
            self.out.line(f"items = collect(now, (source, {by}), {count}, {order}, m)", span)
        self._all_lost(topics, span)
        with self.out.block("if items is None:", span):
            self.out.line("return", span)
        self.out.line("m, count = items[0], len(items)", span)

    # targets

    def _serve(self, targets: Sequence[NamedTarget], when: Node | None = None) -> None:
        """Append the lines that serve targets. `when` is a condition for all of them, beside their own."""
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

    def _all_lost(self, targets: Sequence[NamedTarget], span: SourceSpan, *before: str) -> None:
        """Append the `except` of a `try:` without which no target can be served, with the lines `before` in front."""
        with self.out.block("except FAILURES as error:", span):
            for line in before:
                self.out.line(line, span)
            for name, _ in targets:
                self.out.line(f"lost_{name}(error)", span)
            self.out.line("return", span)

    def _guarded(
        self,
        name: str,
        target: CheckedTarget,
        conditions: Sequence[Node],
        deliver: Deliver,
    ) -> None:
        """A failure of one target is counted for it and does not affect the others."""
        with self.out.block("try:", target.span):
            self._conditional(name, target, conditions, deliver)
        with self.out.block("except FAILURES as error:", target.span):
            self.out.line(f"lost_{name}(error)", target.span)

    def _conditional(
        self,
        name: str,
        target: CheckedTarget,
        conditions: Sequence[Node],
        deliver: Deliver,
    ) -> None:
        """Serve the target if each `when` is true, the message is not older than `ttl`, and `max_rate` allows it."""
        word = "if"
        for condition in conditions:
            with self.out.block(f"{word} not {self._expression(condition)}:", condition.span):
                self._count("messages_filtered", target)
            word = "elif"
        if self.route.ttl:
            with self.out.block(f"{word} clock_ns() > {self._expiry(target)}:", self.route.ttl.span):
                self._count("messages_dropped", target, "stale")
            word = "elif"
        if target.declared.max_rate is not None and target.declared.on_limit is OnLimit.FIRST:
            with self.out.block(f"{word} not limit_{name}(now):", target.span):
                self._count("messages_dropped", target, "rate_limited")
            word = "elif"
        if word == "if":
            deliver(name, target)
            return
        with self.out.block("else:", target.span):
            deliver(name, target)

    def _count(self, metric: str, target: CheckedTarget, *reason: str) -> None:
        index = self.counters.index(metric, self.route.name, target.label, *reason)
        self.out.line(f"counts[{index}] += 1  # {' '.join((metric, *reason))}", target.span)

    def _data(self, name: str, target: CheckedTarget) -> str:
        """Append the lines that make the bytes for a target, and return the expression that is the bytes."""
        if target.plan is None:
            data = "datagram"
        elif target.topic:
            return write_message(self.out, target.plan, name, self.values)
        else:
            data = write_envelope(self.out, target.plan, self.case, name, self.values)
        return f"trimmed({data})" if target.endpoint is not None and target.endpoint.trim_trailing_zeros else data

    def _send(self, name: str, target: CheckedTarget) -> None:
        arguments = self._data(name, target)
        if self.route.ttl or target.deadmen:
            arguments += f", {self._expiry(target)}"
        index = self.counters.index("sent_bytes", self.route.name, target.label)
        self.out.line(f"counts[{index}] += send_{name}({arguments})  # sent_bytes", target.span)
        self._count("datagrams_sent", target)

    def _publish(self, name: str, target: CheckedTarget) -> None:
        self.out.line(f"publish_{name}({self._data(name, target)})", target.span)
        self._count("messages_published", target)

    def _deliver(self, name: str, target: CheckedTarget) -> None:
        """Sent or published now or later. What delivers it then counts it and feeds the deadmen."""
        self.out.line(f"deliver_{name}(now, {self._data(name, target)}, {self._expiry(target)})", target.span)
