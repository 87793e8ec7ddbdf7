"""A table compiled so that its expressions tell when they gave a value. Knows no tests.

The checked routes are rebuilt with a call around each expression, and compiled as ever: what runs is the router's own
code, and gives the same.
"""

from __future__ import annotations

import ast
import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

from router.compiler import Checked
from router.compiler.checked import CheckedCollect, CheckedRoute, CheckedSubscription, CheckedTarget
from router.compiler.expressions import Typed
from router.compiler.plan import Each, Items, Leaf, Plan, Record
from router.compiler.program import Handler, Program
from router.compiler.source import call, placed
from router.errors import SourceSpan

PROBE = "touched_by_a_test"
"""What generated code calls."""

V = TypeVar("V")


@dataclass(frozen=True, slots=True)
class Part:
    """An expression of a route, a condition, or one branch of an `if`. All that `auto` copies is one expression."""

    route: str
    span: SourceSpan
    is_condition: bool = False
    is_branch: bool = False


@dataclass(slots=True)
class Probes:
    """The parts of a table, and what they have given since the last look: whether it was something other than zero."""

    parts: dict[Part, None] = field(default_factory=dict)
    _numbered: list[tuple[Part, str | None]] = field(default_factory=list)
    _outcomes: set[tuple[Part, str | None, bool]] = field(default_factory=set)

    def number(self, part: Part, target: str | None) -> int:
        self.parts.setdefault(part)
        self._numbered.append((part, target))
        return len(self._numbered) - 1

    def touched(self, number: int, value: V) -> V:
        self._outcomes.add((*self._numbered[number], bool(value)))
        return value

    def taken(self) -> set[tuple[Part, str | None, bool]]:
        """Each part with the target that it was for, if it was for one."""
        taken, self._outcomes = self._outcomes, set()
        return taken


def with_probes(checked: Checked, probes: Probes) -> Program:
    """The program of a table without errors, whose handlers tell `probes`."""
    routes = tuple(_Route(each.route.name, probes).route(each) for each in checked.routes)
    program = replace(checked, routes=routes).program
    assert program is not None  # noqa: S101 - it has no errors
    return replace(
        program,
        inbound=_told(program.inbound, probes),
        outbound=_told(program.outbound, probes),
    )


K = TypeVar("K")


def _told(handlers: Mapping[K, Sequence[Handler]], probes: Probes) -> dict[K, tuple[Handler, ...]]:
    constants = {PROBE: probes.touched}
    return {
        key: tuple(replace(each, constants={**each.constants, **constants}) for each in several)
        for key, several in handlers.items()
    }


@dataclass(frozen=True, slots=True)
class _Route:
    """Rebuilds what there is of one route."""

    name: str
    probes: Probes

    def route(self, checked: CheckedRoute) -> CheckedRoute:
        return replace(
            checked,
            targets=tuple(map(self._target, checked.targets)),
            subscriptions=tuple(map(self._feed, checked.subscriptions)),
            collect=self._collect(checked.collect) if checked.collect else None,
        )

    def _target(self, served: CheckedTarget) -> CheckedTarget:
        plan = self._plan(served.plan, served.label) if served.plan else None
        assert plan is None or isinstance(plan, Record)  # noqa: S101 - it was one before
        return replace(served, when=self._condition(served.when), plan=plan)

    def _feed(self, feed: CheckedSubscription) -> CheckedSubscription:
        return replace(
            feed,
            when=self._condition(feed.when),
            for_each=self._typed(feed.for_each) if feed.for_each else None,
            targets=tuple(map(self._target, feed.targets)),
        )

    def _collect(self, collect: CheckedCollect) -> CheckedCollect:
        by, count, order = map(self._typed, (collect.by, collect.count, collect.order))
        return replace(collect, by=by, count=count, order=order)

    def _condition(self, typed: Typed | None) -> Typed | None:
        if typed is None:
            return None
        return replace(typed, node=self._wrapped(typed.node, Part(self.name, typed.span, is_condition=True), None))

    def _typed(self, typed: Typed) -> Typed:
        return replace(typed, node=self._wrapped(typed.node, Part(self.name, typed.span), None))

    def _plan(self, plan: Plan, target: str) -> Plan:
        match plan:
            case Leaf():
                return replace(plan, node=self._expression(plan.node, plan.span, target))
            case Record():
                members = tuple((member, self._plan(made, target)) for member, made in plan.members)
                return replace(plan, members=members)
            case Items():
                return replace(plan, items=tuple(self._plan(item, target) for item in plan.items))
            case Each():
                return replace(plan, values=self._expression(plan.values, plan.span, target))
            case _:
                return plan

    def _expression(self, node: ast.expr, span: SourceSpan, target: str) -> ast.expr:
        """A constant stays as it is. Where the value depends on an `if`, the branches count instead of the whole."""
        if isinstance(node, ast.Constant):
            return node
        branches = _Branches(self, span.file, target)
        made = branches.visit(copy.deepcopy(node))
        assert isinstance(made, ast.expr)  # noqa: S101 - the visitor keeps what it is
        return made if branches.found else self._wrapped(made, Part(self.name, span), target)

    def _wrapped(self, node: ast.expr, part: Part, target: str | None) -> ast.expr:
        return placed(call(PROBE, ast.Constant(self.probes.number(part, target)), node), part.span)

    def branch(self, node: ast.expr, file: str, target: str) -> ast.expr:
        span = SourceSpan(file, node.lineno, node.col_offset + 1, (node.end_col_offset or node.col_offset) + 1)
        return self._wrapped(node, Part(self.name, span, is_branch=True), target)


class _Branches(ast.NodeTransformer):
    """Puts a probe around each branch that a chain of `if` and `else` may end in."""

    def __init__(self, route: _Route, file: str, target: str) -> None:
        self.found = False
        self._route = route
        self._file = file
        self._target = target

    def visit_IfExp(self, node: ast.IfExp) -> ast.expr:
        self.found = True
        node.test = self.visit(node.test)
        node.body = self._branch(node.body)
        node.orelse = self._branch(node.orelse)
        return node

    def _branch(self, node: ast.expr) -> ast.expr:
        if isinstance(node, ast.IfExp):
            return self.visit_IfExp(node)
        made: ast.expr = self.generic_visit(node)  # type: ignore[assignment]
        return self._route.branch(made, self._file, self._target)
