"""Describes what happened in a rehearsal, with the places in the table."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby

from router.compiler import Checked
from router.compiler.checked import CheckedCalled, CheckedService, Target
from router.compiler.compiled_table import CompiledTable, service_label
from router.compiler.plan import Each, Items, Leaf, Plan, Record
from router.datagrams import Wire
from router.errors import DecodeError, SourceSpan
from router.rehearsal import cdr
from router.rehearsal.fields import Path, offset, path_text, shown
from router.rehearsal.rehearsal import (
    START,
    Collected,
    DeadmanChanged,
    Disobeyed,
    Dropped,
    Event,
    Filtered,
    Obeyed,
    Published,
    Received,
    Rejected,
    Sent,
    StateChanged,
    Superseded,
    Unanswered,
)
from router.types.model import MessageType

_MOST_LINES = 12


@dataclass(frozen=True, slots=True)
class Related:
    """A place in the table, and how it is related to a failure."""

    span: SourceSpan
    note: str


class TableIndex:
    """Finds the places of a table by route and target, as events name them."""

    def __init__(self, checked: Checked) -> None:
        self._routes = {route.route.name: route for route in checked.routes}
        services: list[CheckedService | CheckedCalled] = [*checked.services, *checked.called]
        self._services = {service_label(each.declared.name): each for each in services}
        self._targets: dict[tuple[str, str], list[Target]] = {}
        for route in checked.routes:
            for target in (
                *route.targets,
                *(target for subscription in route.subscriptions for target in subscription.targets),
            ):
                self._targets.setdefault((route.route.name, target.label), []).append(target)
            if route.route.name in self._services:  # its replies without a response are a topic of their own
                for subscription in route.subscriptions:
                    for target in subscription.targets:
                        self._targets[subscription.topic.topic.value, target.label] = [target]

    def target(self, route: str, target: str, note: str = "the target") -> Related | None:
        targets = self._targets.get((route, target))
        return Related(targets[0].span, note) if targets else None

    def type(self, route: str, topic: str) -> MessageType | None:
        """Return the type of a topic that a route publishes on, or of the messages for a service."""
        service = self._services.get(topic)
        if service is not None:
            return service.response_type if isinstance(service, CheckedService) else service.request_type
        return next((checked.type for checked in self._targets.get((route, topic), ())), None)

    def delivery(self, target: str) -> str:
        """Return what is done with a message for a topic, or for a service by its label."""
        service = self._services.get(target)
        if service is None:
            return f"is published on {target}"
        return f"{'answers' if isinstance(service, CheckedService) else 'calls'} {service.declared.name}"

    def on_timeout(self, label: str) -> Related | None:
        """Return what a service, by its label, answers without a reply."""
        service = self._services.get(label)
        return Related(service.declared.on_timeout.span, "the answer without a reply") if service else None

    def of_name(self, target: str, routes: Iterable[str]) -> Related | None:
        """Return the target of this name in one of the `routes` that took a message, or else in any."""
        taken = [name for name in routes if name in self._routes]
        related = next((related for name in taken if (related := self.target(name, target))), None)
        if related is None and taken and target not in self._services:
            related = Related(self._routes[taken[0]].route.span, "the route that took it has no such target")
        return related or next((self.target(*key) for key in self._targets if key[1] == target), None)

    def condition(self, route: str, target: str) -> Related | None:
        for checked in self._targets.get((route, target), ()):
            if checked.when is not None:
                return Related(checked.when.span, "withheld by this condition")
        return self.target(route, target)

    def deadman(self, route: str) -> Related | None:
        deadman = self._routes[route].route.deadman if route in self._routes else None
        return Related(deadman.span, "sent by this deadman") if deadman else None

    def obeyed(self, route: str) -> Related | None:
        deadman = self._routes[route].route.deadman if route in self._routes else None
        return Related(deadman.obeyed.when.span, "shown by this condition") if deadman and deadman.obeyed else None

    def field(self, route: str, target: str, path: Path) -> Related | None:
        """Return what fills a field, or else the target that leaves it at its default."""
        for checked in self._targets.get((route, target), ()):
            if checked.plan is None:
                return Related(checked.span, "forwarded here")
            if (span := _filled(checked.plan, path)) is not None:
                return Related(span, f"{path_text(path)} is filled here")
        return self.target(route, target, "nothing here fills it")


def _filled(plan: Plan, path: Path) -> SourceSpan | None:
    match plan:
        case Leaf() | Each():
            return plan.span
        case Record():
            inner = next((member for field, member in plan.members if path and field.name == path[0]), None)
            if inner is None:
                return plan.span if not path else None
            return _filled(inner, path[1:])
        case Items():
            if path and isinstance(path[0], int) and path[0] < len(plan.items):
                return _filled(plan.items[path[0]], path[1:])
            return plan.span
    return None


class EventDescriber:
    """Describes what happened to messages of one table. `index` finds its places."""

    def __init__(self, checked: Checked, program: CompiledTable) -> None:
        self.index = TableIndex(checked)
        self._wire = Wire(program.envelopes)

    def lines(self, events: Iterable[Event]) -> list[str]:
        """Return everything that happened, in order, each with its place in the table."""
        lines = []
        for _, same in groupby(events, _kind):
            alike = [*same]
            line, place = self.summarize(alike), self.related(alike[0])
            if place is not None and place.span.file not in line:  # it is if an expression has no value
                line += f" ({place.span})"
            lines.append(line)
        more = [f"and {len(lines) - _MOST_LINES} more lines"] if len(lines) > _MOST_LINES else []
        return lines[:_MOST_LINES] + more

    def related(self, event: Event) -> Related | None:
        match event:
            case Sent(by_deadman=True) | DeadmanChanged():
                return self.index.deadman(event.route)
            case Obeyed() | Disobeyed():
                return self.index.obeyed(event.route)
            case Filtered():
                return self.index.condition(event.route, event.target)
            case Unanswered():
                return self.index.on_timeout(event.target)
            case Sent() | Published() | Dropped() | Collected():
                return self.index.target(event.route, event.target) or self.index.on_timeout(event.target)
        return None

    def summarize(self, events: Sequence[Event]) -> str:
        more = f", and so on, {len(events)} in total" if len(events) > 1 else ""
        return self.describe(events[0]) + more

    def describe(self, event: Event) -> str:
        """Describe an event: `at 500 ms manual_brake {brake: true} is sent to driving_board`."""
        at = when(event)
        match event:
            case Sent():
                by = f" by the deadman of {event.route}" if event.by_deadman else ""
                return f"{at}{self._datagram(event)} is sent to {event.target}{by}"
            case Published():
                kind = self.index.type(event.route, event.target)
                inside = shown(kind, cdr.deserialize(kind, event.data)) if kind else "a message"
                return f"{at}{inside} {self.index.delivery(event.target)}"
            case Dropped():
                return f"{at}a message for {event.target} is dropped as {event.reason}{in_brackets(event.detail)}"
            case Filtered():
                return f"{at}{event.route} withholds a message from {event.target}"
            case Collected():
                return f"{at}{event.target} waits for the rest of its frame"
            case Received():
                return f"{at}{event.route} takes a message from {event.source}"
            case Rejected():
                return f"{at}{event.listener} rejects a datagram as {event.reason}{in_brackets(event.detail)}"
            case Superseded():
                return f"{at}{event.listener} uses only the last payload of a datagram{in_brackets(event.detail)}"
            case DeadmanChanged() | Obeyed() | Disobeyed() | StateChanged() | Unanswered():
                return at + _of_change(event)
        raise AssertionError(event)

    def _datagram(self, event: Sent) -> str:
        try:
            decoded = self._wire.decode(event.data, self._wire.envelopes.to(event.target))
        except DecodeError:
            return event.data.hex(" ")
        return f"{decoded.case.name} {shown(decoded.case.type, decoded.message)}"


def _kind(event: Event) -> tuple[object, ...]:
    """Return a key that is equal for events that differ only in time and content."""
    names = (getattr(event, name, None) for name in ("route", "target", "source", "reason", "by_deadman", "state"))
    return type(event), *names


def _of_change(event: DeadmanChanged | Obeyed | Disobeyed | StateChanged | Unanswered) -> str:
    match event:
        case Unanswered():
            return f"a call of {event.target} ends as {event.outcome}"
        case StateChanged(_, state, before, after, source):
            return f"state.{state} changes from {before} to {after}" + (f", set by {source}" if source else "")
        case DeadmanChanged():
            return f"the deadman of {event.route} {'trips' if event.active else 'is released'}"
        case Obeyed():
            return f"{event.target} obeys the deadman of {event.route}, after {offset(event.after)}"
        case Disobeyed():
            return f"{event.target} does not obey the deadman of {event.route}"


def in_brackets(detail: str) -> str:
    return f" ({detail})" if detail else ""


def when(event: Event) -> str:
    """Return `at 500 ms `; empty at the beginning of the test."""
    return f"at {offset(event.at - START)} " if event.at != START else ""
