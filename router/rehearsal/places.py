"""Where a table says what a test has found: of a target, of a field of it, of a condition, of a deadman."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from router.compiler import Checked
from router.compiler.checked import CheckedTarget
from router.compiler.plan import Each, Items, Leaf, Plan, Record
from router.errors import SourceSpan
from router.rehearsal.matching import Path, path_text
from router.types.model import MessageType


@dataclass(frozen=True, slots=True)
class Place:
    """A stretch of the table, and what it has to do with a failure."""

    span: SourceSpan
    note: str


class Places:
    def __init__(self, checked: Checked) -> None:
        self._routes = {route.route.name: route for route in checked.routes}
        self._targets: dict[tuple[str, str], list[CheckedTarget]] = {}
        for route in checked.routes:
            served = [*route.targets, *(target for feed in route.subscriptions for target in feed.targets)]
            for target in served:
                self._targets.setdefault((route.route.name, target.label), []).append(target)

    def target(self, route: str, target: str, note: str = "the target") -> Place | None:
        found = self._targets.get((route, target))
        return Place(found[0].span, note) if found else None

    def type(self, route: str, topic: str) -> MessageType | None:
        """Of a topic that a route publishes on."""
        return next((served.type for served in self._targets.get((route, topic), ())), None)

    def of_name(self, target: str, routes: Iterable[str]) -> Place | None:
        """The target called so of the `routes` that took a message, else the first of them; of any route without."""
        taken = [name for name in routes if name in self._routes]
        place = next((found for name in taken if (found := self.target(name, target))), None)
        if place is None and taken:
            place = Place(self._routes[taken[0]].route.span, "the route that took it has no such target")
        return place or next((self.target(*key) for key in self._targets if key[1] == target), None)

    def condition(self, route: str, target: str) -> Place | None:
        for served in self._targets.get((route, target), ()):
            if served.when is not None:
                return Place(served.when.span, "withheld by this condition")
        return self.target(route, target)

    def deadman(self, route: str) -> Place | None:
        deadman = self._routes[route].route.deadman if route in self._routes else None
        return Place(deadman.span, "sent by this deadman") if deadman else None

    def field(self, route: str, target: str, path: Path) -> Place | None:
        """What fills a field, else the target that leaves it at its default."""
        for served in self._targets.get((route, target), ()):
            plan = served.plan
            if plan is None:
                return Place(served.span, "forwarded here")
            if (span := _filled(plan, path)) is not None:
                return Place(span, f"what fills {path_text(path)}")
        return self.target(route, target, "nothing here fills it")


def _filled(plan: Plan, path: Path) -> SourceSpan | None:
    match plan:
        case Leaf() | Each():
            return plan.span
        case Record():
            inner = next((made for field, made in plan.members if path and field.name == path[0]), None)
            if inner is None:
                return plan.span if not path else None
            return _filled(inner, path[1:])
        case Items():
            if path and isinstance(path[0], int) and path[0] < len(plan.items):
                return _filled(plan.items[path[0]], path[1:])
            return plan.span
    return None
