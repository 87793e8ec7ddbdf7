"""From a checked route to the Python function that serves it, about one screen long.

The function takes a parsed message and calls what the engine binds for each target NAME: `send_NAME` or
`publish_NAME` and `wanted_NAME`, `limit_NAME` for a `max_rate`, and `lost_NAME` for whatever fails.
It counts in a flat list. `router explain` prints it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

from router.compiler.books import DROP_REASONS, Books
from router.compiler.cdr import write_message
from router.compiler.expressions import Locals
from router.compiler.plan import Record
from router.compiler.program import TargetPlan
from router.compiler.source import Source, namespace_name
from router.compiler.syntax import attribute, load, placed
from router.compiler.target import Target
from router.errors import SourceSpan

PARAMETERS = ("m", "datagram", "received_at", "now", "source")


class HandlerSource:
    """Generates `def route_CASE(m, datagram, received_at, now, source)` for one route."""

    def __init__(self, case: str, books: Books, span: SourceSpan) -> None:
        self.case = case
        self.function = f"route_{case}"  # a case may be called as a keyword, or as a function of the language
        self.books = books
        self.span = span
        self.out = Source()
        self.plans: list[TargetPlan] = []

    def generate(self, targets: Sequence[Target]) -> None:
        """Destinations first: forwarding waits for no mapping."""
        with self.out.block(f"def {self.function}({', '.join(PARAMETERS)}):", self.span):
            for target in targets:
                self._target(target)
            if not targets:
                self.out.line("pass", self.span)

    def _target(self, target: Target) -> None:
        self._open_books(target)
        name = self._unique(namespace_name(target.name))
        self.plans.append(TargetPlan(name, target.name, target.plan is not None, target.max_rate))
        plan = target.plan
        self.out.line(f"# {'topic' if plan else 'destination'} {target.name}", target.span)
        if plan is None:
            self._guarded(target, name, lambda: self._send(target, name))
            return
        with self.out.block(f"if wanted_{name}[0]:", target.span):
            self._guarded(target, name, lambda: self._publish(target, name, plan))
        with self.out.block("else:", target.span):
            self._count("messages_filtered", target)

    def _open_books(self, target: Target) -> None:
        """Every series exists from the start."""
        for reason in DROP_REASONS:
            self.books.slot("messages_dropped", self.case, target.name, reason)
        self.books.slot("messages_filtered", self.case, target.name)

    def _unique(self, base: str) -> str:
        """`a/b` and `a_b` are different topics but would be one Python name."""
        taken = {plan.name for plan in self.plans}
        candidates = (f"{base}_{number}" if number > 1 else base for number in itertools.count(1))
        return next(name for name in candidates if name not in taken)

    def _count(self, metric: str, target: Target, *reason: str) -> None:
        slot = self.books.slot(metric, self.case, target.name, *reason)
        self.out.line(f"counts[{slot}] += 1  # {' '.join((metric, *reason))}", target.span)

    def _guarded(self, target: Target, name: str, serve: Callable[[], None]) -> None:
        """What fails for one target is counted there and leaves the others alone."""
        with self.out.block("try:", target.span):
            bind_locals(self.out, target.locals, target.span)
            self._limited(target, name, serve)
        with self.out.block("except FAILURES as error:", target.span):
            self.out.line(f"lost_{name}(error)", target.span)

    def _limited(self, target: Target, name: str, serve: Callable[[], None]) -> None:
        """Serves the target if its `when` is true and its `max_rate` is not used up."""
        if target.when is None and target.max_rate is None:
            serve()
            return
        if target.when is not None:
            with self.out.block(f"if not {self.out.expression(target.when.node)}:", target.when.span):
                self._count("messages_filtered", target)
        if target.max_rate is not None:
            word = "if" if target.when is None else "elif"
            with self.out.block(f"{word} not limit_{name}(now):", target.span):
                self._count("messages_dropped", target, "rate_limited")
        with self.out.block("else:", target.span):
            serve()

    def _send(self, target: Target, name: str) -> None:
        datagram = "datagram.rstrip(ZERO)" if target.trim else "datagram"
        slot = self.books.slot("sent_bytes", self.case, target.name)
        self.out.line(f"counts[{slot}] += send_{name}({datagram})  # sent_bytes", target.span)
        self._count("datagrams_sent", target)

    def _publish(self, target: Target, name: str, plan: Record) -> None:
        self.out.line(f"publish_{name}({write_message(self.out, plan, name)})", target.span)
        self._count("messages_published", target)


def bind_locals(out: Source, variables: Locals, span: SourceSpan) -> None:
    """Appends an assignment for each submessage that expressions look into."""
    for path, local in variables.bound.items():
        made = placed(attribute(load(variables.name(path[:-1])), path[-1]), span)
        out.line(f"{local} = {out.expression(made)}", span)
