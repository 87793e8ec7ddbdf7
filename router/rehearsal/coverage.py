"""The routes, targets and rejections of a table that its tests have touched, from the router's counters.

A step counts only if it expects something (not `any`), and a target only if its message was compared with something.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from router.compiler import Checked
from router.compiler.checked import CheckedRoute, Target
from router.compiler.compiled_table import CompiledTable, service_label
from router.compiler.expressions.tree import Node
from router.errors import SourceSpan
from router.rehearsal.comparing import Outcome
from router.rehearsal.rehearsal import (
    Disobeyed,
    Dropped,
    Event,
    Filtered,
    Obeyed,
    Published,
    Received,
    Rejected,
    Sent,
    Unanswered,
)
from router.rehearsal.steps import Expected
from router.table.model.routes import ANY
from router.table.model.services import CalledService, Service

KINDS = ("route", "target", "rejection")

Key = tuple[str, ...]
"""What is touched: a kind, such as `route` or a reason of the metrics, then names of listener, route and target."""


@dataclass(frozen=True, slots=True)
class Item:
    """Something that tests should touch; `gap` is the message if none does."""

    kind: str
    span: SourceSpan
    gap: str


class Coverage:
    """The coverage of one table by the tests of a file, and by those of others that are added."""

    def __init__(self, checked: Checked, program: CompiledTable) -> None:
        self.path: Path = checked.path
        self._items: dict[Key, Item] = {}
        self._touched: set[Key] = set()
        for key, item in _items(checked, program):
            self._items.setdefault(key, item)

    def record(self, outcome: Outcome) -> None:
        """Record what a step of a test has touched."""
        expected = outcome.step.expected
        if not expected.anything:
            self._touched.update(key for event in outcome.events for key in _keys(event, expected))

    def add(self, other: Coverage) -> None:
        """Add what another test file has touched in the same table, whatever its variables."""
        self._items = other._items | self._items
        self._touched |= other._touched

    def inherit(self, other: Coverage) -> None:
        """Add what the tests of another table have touched in parts that both tables take from the same file."""
        places = {key: _real(item.span) for key, item in other._items.items() if key in other._touched}
        self._touched |= {key for key, item in self._items.items() if places.get(key) == _real(item.span)}

    def gaps(self) -> list[Item]:
        """Return what no test has touched."""
        return [item for key, item in self._items.items() if key not in self._touched]

    @property
    def is_complete(self) -> bool:
        return not self.gaps()

    def counts(self) -> dict[str, tuple[int, int]]:
        """Return, by kind, how many items were touched, and how many there are."""
        there = [item.kind for item in self._items.values()]
        missing = [item.kind for item in self.gaps()]
        return {kind: (there.count(kind) - missing.count(kind), there.count(kind)) for kind in KINDS}


def _real(span: SourceSpan) -> SourceSpan:
    """Return the span with the real path of its file: tables may extend it by different paths."""
    return replace(span, file=os.path.realpath(span.file))


# What there is to touch


def _items(checked: Checked, program: CompiledTable) -> Iterator[tuple[Key, Item]]:
    routes = [route for route in checked.routes if not route.route.ignore]
    for route in routes:
        name = route.route.name
        yield ("route", name), Item("route", route.route.span, f"no test has a message for the route {name}")
    for state in checked.states.values():
        if state.feed is not None:
            gap = f"no test has a message that sets {state.label}"
            yield ("route", state.label), Item("route", state.declared.span, gap)
    for route in routes:
        yield from _targets(route)
    if any(source.value != ANY for route in routes for source in route.route.sources):
        for listener in program.table.listeners.values():
            gap = f"no test has a datagram at {listener.name} from a sender that its route does not accept"
            yield ("source_mismatch", listener.name), Item("rejection", listener.span, gap)
    for endpoint in program.table.endpoints.values():
        if endpoint.bandwidth is not None:
            gap = f"no test exceeds the bandwidth of {endpoint.name}"
            yield ("queue_full", endpoint.name), Item("rejection", endpoint.span, gap)
    for route in routes:
        yield from _rejections(route)
    yield from _of_services(checked)


def _of_services(checked: Checked) -> Iterator[tuple[Key, Item]]:
    """Yield what services have besides their routes and targets."""
    services: list[Service | CalledService] = [each.declared for each in checked.services]
    services += [each.declared for each in checked.called]
    for declared in services:
        gap = f"no test has a call of {declared.name} that times out"
        yield ("timed_out", service_label(declared.name)), Item("rejection", declared.on_timeout.span, gap)


def _targets(route: CheckedRoute) -> Iterator[tuple[Key, Item]]:
    name = route.route.name
    for target, _ in _with_conditions(route):
        gap = f"no test checks what {name} delivers to {target.label}"
        yield ("target", name, target.label), Item("target", target.span, gap)
    if deadman := route.route.deadman:
        for to in deadman.to:
            gap = f"no test checks what the deadman of {name} sends to {to.value}"
            yield ("deadman", name, to.value), Item("target", deadman.span, gap)
    if (obeyed := route.obeyed) is not None:
        for endpoint in obeyed.endpoints:
            gap = f"no test has {endpoint} obey the deadman of {name}"
            yield ("obeyed", name, endpoint), Item("target", obeyed.when.span, gap)


def _rejections(route: CheckedRoute) -> Iterator[tuple[Key, Item]]:
    """Yield the settings of a table that keep messages of a route from its targets."""
    name = route.route.name
    if ttl := route.route.ttl:
        yield ("stale", name), Item("rejection", ttl.span, f"no test has a message of {name} that is older than this")
    if order := route.route.order:
        gap = f"no test has a message of {name} that is out of order"
        yield ("out_of_order", name), Item("rejection", order.span, gap)
    if collect := route.route.collect:
        gap = f"no test has a frame of {name} that stays incomplete"
        yield ("incomplete", name), Item("rejection", collect.span, gap)
    if (obeyed := route.obeyed) is not None:
        for endpoint in obeyed.endpoints:
            gap = f"no test has {endpoint} disobey the deadman of {name}"
            yield ("disobeyed", name, endpoint), Item("rejection", obeyed.when.span, gap)
    for target, condition in _with_conditions(route):
        if condition is not None:
            gap = f"no test has a message of {name} that this withholds from {target.label}"
            yield ("filtered", name, target.label), Item("rejection", condition.span, gap)
        declared = route.route.reply if target.reply else target.declared  # which has no default rate
        if declared is not None and declared.max_rate is not None:
            gap = f"no test exceeds the max_rate of {name} to {target.label}"
            yield ("rate_limited", name, target.label), Item("rejection", target.span, gap)


def _with_conditions(route: CheckedRoute) -> Iterator[tuple[Target, Node | None]]:
    """Yield every target of a route, with its `when` or that of the topic that feeds it."""
    yield from ((target, target.when) for target in route.targets)
    for subscription in route.subscriptions:
        yield from ((target, target.when or subscription.when) for target in subscription.targets)


def _keys(event: Event, expected: Expected) -> Iterator[Key]:
    """Yield the keys that an event touches in a step with these expectations."""
    match event:
        case Received():
            yield "route", event.route
        case Unanswered(outcome="timed_out"):
            yield event.outcome, event.target
        case Sent() if any(delivery.is_compared for delivery in expected.sent.get(event.target, ())):
            yield "deadman" if event.by_deadman else "target", event.route, event.target
        case Published() if any(delivery.is_compared for delivery in expected.published.get(event.target, ())):
            yield "target", event.route, event.target
        case Filtered() | Obeyed() | Disobeyed():
            yield type(event).__name__.lower(), event.route, event.target
        case Rejected():
            yield event.reason, event.listener
        case Dropped(reason="queue_full"):
            yield event.reason, event.target
        case Dropped(reason="rate_limited"):
            yield event.reason, event.route, event.target
        case Dropped():
            yield event.reason, event.route
