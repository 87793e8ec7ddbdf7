"""The lines of a handler that serve its targets: which of them get the message, what they get, how it is counted.

What the message is and where it comes from is written before, by `handlers`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from router.compiler.cdr import write_message
from router.compiler.expressions import Typed
from router.compiler.metrics import DROP_REASONS, Counters
from router.compiler.payload import write_envelope
from router.compiler.program import TargetPlan
from router.compiler.source import Source, namespace_name
from router.compiler.target import Target
from router.errors import SourceSpan
from router.table.model import Keep, Route
from router.types.protobuf import PayloadCase

NamedTarget = tuple[str, Target]
"""A target with its part of the Python names."""


@dataclass(slots=True)
class ServingSource:
    """Appends to `out` what serves targets of `route`. `plans` are those that were named so far."""

    out: Source
    route: Route
    case: PayloadCase
    counters: Counters
    plans: list[TargetPlan] = field(default_factory=list)

    def named(self, target: Target) -> NamedTarget:
        """Opens the target's series, which all exist from the start."""
        for reason in DROP_REASONS:
            self.counters.index("messages_dropped", self.route.name, target.name, reason)
        self.counters.index("messages_filtered", self.route.name, target.name)
        delivered = ("messages_published",) if target.is_topic else ("datagrams_sent", "sent_bytes")
        for metric in delivered:
            self.counters.index(metric, self.route.name, target.name)
        name = self._unique(namespace_name(target.name))
        self.plans.append(
            TargetPlan(
                name=name,
                target=target.name,
                is_topic=target.is_topic,
                max_rate=target.max_rate,
                keep=target.keep,
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
            self.out.line(f"# {'topic' if target.is_topic else 'destination'} {target.name}", target.span)
            conditions = [condition for condition in (when, target.when) if condition is not None]
            if not target.is_topic:
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
        self, name: str, target: Target, conditions: Sequence[Typed], serve: Callable[[str, Target], None]
    ) -> None:
        """What fails for one target is counted there and leaves the others alone."""
        with self.out.block("try:", target.span):
            if target.reads is not None:
                target.reads.write(self.out, target.span)
            self._conditional(name, target, conditions, serve)
        with self.out.block("except FAILURES as error:", target.span):
            self.out.line(f"lost_{name}(error)", target.span)

    def _conditional(
        self, name: str, target: Target, conditions: Sequence[Typed], serve: Callable[[str, Target], None]
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
        if target.max_rate is not None and target.keep is Keep.FIRST:
            with self.out.block(f"{word} not limit_{name}(now):", target.span):
                self._count("messages_dropped", target, "rate_limited")
            word = "elif"
        if word == "if":
            serve(name, target)
            return
        with self.out.block("else:", target.span):
            serve(name, target)

    def _count(self, metric: str, target: Target, *reason: str) -> None:
        index = self.counters.index(metric, self.route.name, target.name, *reason)
        self.out.line(f"counts[{index}] += 1  # {' '.join((metric, *reason))}", target.span)

    def _data(self, name: str, target: Target) -> str:
        """Appends what makes the bytes for a target, and returns the expression that is them."""
        if target.plan is None:
            data = "datagram"
        elif target.is_topic:
            return write_message(self.out, target.plan, name)
        else:
            data = write_envelope(self.out, target.plan, self.case, name)
        return f"{data}.rstrip(ZERO)" if target.trim else data

    def _send(self, name: str, target: Target) -> None:
        data = self._data(name, target)
        if target.deadmen:  # before the command is sent, so that nothing which a deadman sends can follow it
            self.out.line(f"feed_{name}(now)", target.span)
        index = self.counters.index("sent_bytes", self.route.name, target.name)
        self.out.line(f"counts[{index}] += send_{name}({data})  # sent_bytes", target.span)
        self._count("datagrams_sent", target)

    def _publish(self, name: str, target: Target) -> None:
        self.out.line(f"publish_{name}({self._data(name, target)})", target.span)
        self._count("messages_published", target)

    def _deliver(self, name: str, target: Target) -> None:
        """Sent or published now or later; counted there, and deadmen are told there."""
        data = self._data(name, target)
        expires = "expires" if self.route.ttl else "None"
        self.out.line(f"deliver_{name}(now, {data}, {expires})", target.span)
