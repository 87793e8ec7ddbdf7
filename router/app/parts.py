"""Who serves the targets of a route from UDP when the carrier receives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import Enum, auto

from router.compiler.program import Handler, Program, TargetPlan


class Part(Enum):
    """Some targets of a route. All but the first have a queue and a thread of their own."""

    SENT = auto()
    """Destinations to which the receive thread sends."""

    PUBLISHED = auto()
    """Topics on which a native thread publishes."""

    TOPICS = auto()
    """Other topics, and other destinations: Python serves them."""

    DESTINATIONS = auto()


OF_PYTHON = {Part.TOPICS: "topics", Part.DESTINATIONS: "destinations"}
"""The parts that threads of Python serve, with the names of these threads."""

Parts = Mapping[Part, Mapping[str, Sequence[TargetPlan]]]
"""By part and route. A route without targets in a part is not there."""


def divided(program: Program, *, publishes: bool) -> Parts:
    """Divide the targets of all routes. `publishes`: there is a native thread that does."""
    parts: dict[Part, dict[str, list[TargetPlan]]] = {part: {} for part in Part}
    for handlers in program.inbound.values():
        for handler in handlers:
            for target in handler.targets:
                part = _part(program, handler, target, publishes)
                parts[part].setdefault(handler.route, []).append(target)
    return parts


def _part(program: Program, handler: Handler, target: TargetPlan, publishes: bool) -> Part:
    if target.is_topic:
        is_lowered = program.executors[handler.route, target.label, None].is_carrier
        return Part.PUBLISHED if publishes and is_lowered else Part.TOPICS
    is_carried = program.executors[handler.route, None, target.label].is_carrier
    return Part.SENT if is_carried else Part.DESTINATIONS
