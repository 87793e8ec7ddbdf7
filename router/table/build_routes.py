"""Routes: nodes that have their shape to Route, Deadman and Collect, each route with a name of its own.

Knows the schema's shape; which names exist is the compiler's business.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from router.errors import SourceSpan
from router.table.build_fields import constants, expression, fields, optional_expression
from router.table.build_targets import destination, item_span, topic
from router.table.model import Collect, Deadman, Located, Priority, Route
from router.table.nodes import Entry, MappingNode, ScalarNode, SequenceNode
from router.table.reading import duration, items, located, mapping, needed_duration, optional_text

DEFAULT_REPEAT = 100_000_000
"""How often a deadman sends, in ns, unless the table says it."""


def build_case(entry: Entry) -> tuple[Route, ...]:
    """The routes of one payload case, all named after the case so far."""
    if not isinstance(entry.value, SequenceNode):
        return (_route(entry.key, mapping(entry.value), entry.key.span),)
    listed = map(mapping, entry.value.items)
    return tuple(_route(entry.key, settings, item_span(settings)) for settings in listed)


def named(cases: Iterable[tuple[Route, ...]]) -> tuple[Route, ...]:
    """The routes of all cases, with names that tell them apart in metrics and log.

    A case's only route keeps the case's name; of several each is named after its first source.
    """
    cases = tuple(cases)
    taken = {route.name for routes in cases for route in routes}
    found: list[Route] = []
    for routes in cases:
        for route in routes:
            name = route.name if len(routes) == 1 else _free(f"{route.name}_from_{route.sources[0].value}", taken)
            taken.add(name)
            found.append(replace(route, name=name))
    return tuple(found)


def _free(name: str, taken: set[str]) -> str:
    """The name, or with the first of `_2`, `_3`, ... behind it with which it is not taken."""
    free, number = name, 1
    while free in taken:
        number += 1
        free = f"{name}_{number}"
    return free


def _route(case: ScalarNode, settings: MappingNode, span: SourceSpan) -> Route:
    source = settings.get("source")
    names = source.items if isinstance(source, SequenceNode) else (source,) if source else ()
    deadman = settings.entries.get("deadman")
    collect = settings.entries.get("collect")
    is_reason = deadman is not None and isinstance(deadman.value, ScalarNode)
    return Route(
        name=case.text,
        span=span,
        case=Located(case.text, case.span),
        sources=tuple(map(located, names)),
        destinations=tuple(map(destination, items(settings, "destinations"))),
        topics=tuple(map(topic, items(settings, "topics"))),
        fields=fields(settings),
        ignore=optional_text(settings, "ignore"),
        ttl=duration(settings, "ttl"),
        deadman=_deadman(deadman) if deadman and not is_reason else None,
        no_deadman=located(deadman.value) if deadman and is_reason else None,
        for_each=optional_expression(settings, "for_each"),
        collect=_collect(collect) if collect else None,
        priority=_priority(settings),
    )


def _deadman(entry: Entry) -> Deadman:
    settings = mapping(entry.value)
    [payload] = mapping(settings.get("send")).entries.values()
    return Deadman(
        span=entry.key.span,
        timeout=needed_duration(settings, "timeout"),
        case=located(payload.key),
        fields=constants(payload),
        to=tuple(map(located, items(settings, "to"))),
        repeat=duration(settings, "repeat") or Located(DEFAULT_REPEAT, entry.key.span),
        hands_over_to=tuple(map(located, items(settings, "hands_over_to"))),
        at_start=sends_at_start(settings),
    )


def sends_at_start(deadman: MappingNode) -> bool:
    written = optional_text(deadman, "at_start")
    return written is None or written.value == "send"


def _collect(entry: Entry) -> Collect:
    settings = mapping(entry.value)
    return Collect(
        span=entry.key.span,
        by=expression(settings.get("by")),
        count=expression(settings.get("count")),
        order=expression(settings.get("order")),
        timeout=needed_duration(settings, "timeout"),
    )


def _priority(settings: MappingNode) -> Located[Priority] | None:
    written = optional_text(settings, "priority")
    return Located(Priority(written.value), written.span) if written else None
