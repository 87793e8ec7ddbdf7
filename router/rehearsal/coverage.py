"""What of a table its tests have touched: routes, targets, expressions.

Where a table is compiled for this, each of its expressions tells when it gave a value. Something counts as touched
only in a step that the test looks at, an expression only where the message that it filled was compared.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from router.compiler.checked import CheckedRoute
from router.compiler.program import Program
from router.errors import SourceSpan
from router.rehearsal.events import Published, Received, Sent
from router.rehearsal.model import Item, Payload, TableTestFile, Whatever
from router.rehearsal.probes import Part, Probes, with_probes
from router.rehearsal.words import Happened

Route = str
Target = str


@dataclass(frozen=True, slots=True)
class Gap:
    """Something that no test has touched; `what` says it in words."""

    span: SourceSpan
    kind: str
    what: str


@dataclass(slots=True)
class Coverage:
    """The coverage of one table by a file of tests, and by others that were added. `program` has probes in it."""

    program: Program
    routes: tuple[CheckedRoute, ...]
    probes: Probes
    _routes: set[Route] = field(default_factory=set)
    _targets: set[tuple[Route, Target, bool]] = field(default_factory=set)
    _outcomes: set[tuple[Part, bool]] = field(default_factory=set)

    @classmethod
    def of(cls, file: TableTestFile) -> Coverage:
        probes = Probes()
        routes = tuple(checked for checked in file.checked.routes if not checked.route.ignore)
        return cls(with_probes(file.checked, probes), routes, probes)

    def saw(self, happened: Happened) -> None:
        """A step of a test has run."""
        outcomes = self.probes.taken()
        if happened.step.expected.anything:
            return
        compared = set(_compared(happened))
        self._targets |= compared
        self._routes |= {event.route for event in happened.events if isinstance(event, Received)}
        for part, target, outcome in outcomes:
            if target is None or part.is_condition or (part.route, target, False) in compared:
                self._outcomes.add((part, outcome))

    def add(self, other: Coverage) -> None:
        """What another file of tests has touched of the same table, whatever it fills its variables with."""
        self.probes.parts |= other.probes.parts
        self._routes |= other._routes
        self._targets |= other._targets
        self._outcomes |= other._outcomes

    def learn(self, other: Coverage) -> None:
        """What the tests of another table have touched counts here too, where it stands at the same place of a file."""
        routes = {(name, _place(span)) for name, span in other._all_routes() if name in other._routes}
        self._routes |= {name for name, span in self._all_routes() if (name, _place(span)) in routes}
        targets = {(key, _place(span)) for key, span in other._all_targets() if key in other._targets}
        self._targets |= {key for key, span in self._all_targets() if (key, _place(span)) in targets}
        parts = {replace(part, span=_place(part.span)): part for part in self.probes.parts}
        placed = [(replace(part, span=_place(part.span)), outcome) for part, outcome in other._outcomes]
        self._outcomes |= {(parts[part], outcome) for part, outcome in placed if part in parts}

    @property
    def is_complete(self) -> bool:
        return not list(self.gaps())

    def counts(self) -> dict[str, tuple[int, int]]:
        """Of routes, targets and expressions: how many were touched, and how many there are."""
        there = {
            "route": len(self.routes),
            "target": len(list(self._all_targets())),
            "expression": len(self.probes.parts),
        }
        missing = [gap.kind for gap in self.gaps()]
        return {kind: (count - missing.count(kind), count) for kind, count in there.items()}

    def gaps(self) -> Iterator[Gap]:
        for name, span in self._all_routes():
            if name not in self._routes:
                yield Gap(span, "route", f"no test has a message for the route {name}")
        for key, span in self._all_targets():
            if key not in self._targets:
                route, target, by_deadman = key
                source = f"the deadman of {route} sends" if by_deadman else f"{route} has"
                yield Gap(span, "target", f"no test compares what {source} for {target}")
        for part in self.probes.parts:
            if why := self._missing(part):
                yield Gap(part.span, "expression", why)

    def _missing(self, part: Part) -> str:
        outcomes = {outcome for touched, outcome in self._outcomes if touched == part}
        where = f"in a compared message of {part.route}"
        if part.is_condition:
            words = {True: "held", False: "withheld anything"}
            never = [word for outcome, word in words.items() if outcome not in outcomes]
            return f"this condition has never {' nor '.join(never)} in a test" if never else ""
        if part.is_branch:
            return "" if outcomes else f"this branch was never taken {where}"
        if True in outcomes:
            return ""
        return f"this gave nothing but zero {where}" if outcomes else f"this was never used {where}"

    def _all_routes(self) -> Iterator[tuple[Route, SourceSpan]]:
        return ((checked.route.name, checked.route.span) for checked in self.routes)

    def _all_targets(self) -> Iterator[tuple[tuple[Route, Target, bool], SourceSpan]]:
        """Each once, with whether it is a deadman's."""
        seen = set()
        for checked in self.routes:
            name = checked.route.name
            served = [*checked.targets, *(target for feed in checked.subscriptions for target in feed.targets)]
            found = [((name, each.label, False), each.span) for each in served]
            if checked.deadman and checked.route.deadman:
                found += [((name, to.value, True), checked.route.deadman.span) for to in checked.route.deadman.to]
            for key, span in found:
                if key not in seen:
                    seen.add(key)
                    yield key, span


def _place(span: SourceSpan) -> SourceSpan:
    """The same for each path that a table may be extended by."""
    return replace(span, file=os.path.realpath(span.file))


def _compared(happened: Happened) -> Iterator[tuple[Route, Target, bool]]:
    """What got a message in this step that the test says something about."""
    expected = happened.step.expected
    for event in happened.events:
        if isinstance(event, Sent) and any(map(_is_looked_at, expected.sent.get(event.endpoint, ()))):
            yield event.route, event.endpoint, event.by_deadman
        elif isinstance(event, Published) and any(map(_is_looked_at, expected.published.get(event.topic, ()))):
            yield event.route, event.topic, False


def _is_looked_at(item: Item) -> bool:
    content = item.content
    return not isinstance(content, Whatever) and not (isinstance(content, Payload) and content.fields is None)
