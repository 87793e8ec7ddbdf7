"""What one table does otherwise than another, in words: what is added, removed or changed, part by part.

Compares what tables mean, not how they say it: a field that `auto` fills is the same as one that is mapped by hand.
Knows no running router, and no file but by the positions that findings have too.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from router.compiler.check import Checked
from router.compiler.checked import CheckedRoute, CheckedTarget
from router.compiler.topics import qos_of
from router.errors import SourceSpan, shown_path
from router.table.model import Deadman, Destination, Gateway, InboundDeadman, Route, RouteTable, Topic
from router.table.quantities import duration
from router.tools.settings_text import field_map, flat

NONE = "none"
"""Stands for a setting that one of the tables does not have."""


@dataclass(frozen=True, slots=True)
class Part:
    """Something of a table with its settings as text. `about` is what a reader wants to know of it when it is new."""

    span: SourceSpan
    about: str
    settings: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Difference:
    """`subject` is such as `route imu_info`, `part` such as `topic imu_data`, empty for the subject itself.

    `text` says what is different; `span` is where, for what is removed in the old table.
    """

    subject: str
    part: str
    text: str
    span: SourceSpan


Named = tuple[tuple[str, str], Part]
"""Subject, part of it, and what that is."""


def differences(old: Checked, new: Checked) -> list[Difference]:
    """All of them, in the order of the new table, removed ones last; both tables are without errors.

    What belongs to something that is added or removed as a whole is not told again.
    """
    before, after = dict(_parts(old)), dict(_parts(new))
    found = []
    for (subject, name), part in after.items():
        if (was := before.get((subject, name))) is not None:
            texts = _changes(was.settings, part.settings)
            found += [Difference(subject, name, text, part.span) for text in texts]
        elif not name or (subject, "") in before:
            found.append(Difference(subject, name, f"added, {part.about}" if part.about else "added", part.span))
    for (subject, name), part in before.items():
        if (subject, name) not in after and (not name or (subject, "") in after):
            found.append(Difference(subject, name, "removed", part.span))
    return found


def _changes(old: Mapping[str, str], new: Mapping[str, str]) -> Iterator[str]:
    for name in dict.fromkeys((*new, *old)):
        now, was = new.get(name, NONE), old.get(name, NONE)
        if now != was:
            yield f"{name} is {' '.join(now.split())}, was {' '.join(was.split())}"


def _parts(checked: Checked) -> Iterator[Named]:
    """Everything that a table says, by what it is called."""
    table, envelope, schema = checked.table, checked.envelope, checked.schema
    if table is None or envelope is None or schema is None:
        raise ValueError(f"{checked.path} has errors")
    yield from _surroundings(table)
    for case in envelope.cases.values():
        settings = {"number": str(case.number), "message": case.type.name}
        about = f"{case.type.name}, number {case.number}"
        yield (f"payload case {case.name}", ""), Part(schema.span(envelope.name, case.name), about, settings)
    for listener in table.listeners.values():
        yield (f"listener {listener.name}", ""), Part(listener.span, listener.bound_to, flat(listener))
    for endpoint in table.endpoints.values():
        yield (f"endpoint {endpoint.name}", ""), Part(endpoint.span, str(endpoint.address.value), flat(endpoint))
    for route in checked.routes:
        for name, part in _route_parts(route):
            yield (f"route {route.route.name}", name), part
    for gateway in table.gateways.values():
        for name, part in _gateway_parts(gateway):
            yield (f"gateway {gateway.name}", name), part


def _surroundings(table: RouteTable) -> Iterator[Named]:
    """What is neither endpoint nor route. It is always there, so that it can only change."""
    settings = {
        "node": f"{table.node.namespace.rstrip('/')}/{table.node.name}",
        **flat(table.node.diagnostics is not None, "node.diagnostics"),
        **flat(table.reload_on_change, "reload.on_change"),
        **flat(table.metrics, "metrics.address"),
        **flat(table.foxglove, "foxglove.address"),
    }
    yield ("table", ""), Part(SourceSpan(shown_path(table.path)), "", settings)
    if table.record is not None:
        directory = shown_path(Path(os.path.normpath(table.record.directory)))
        yield ("record", ""), Part(table.record.span, directory, flat(table.record))


def _route_parts(checked: CheckedRoute) -> Iterator[tuple[str, Part]]:
    route = checked.route
    sources = ", ".join(source.value for source in route.sources)
    yield "", Part(route.span, f"from {sources}" if sources else "ignored", _route_settings(route))
    if route.deadman is not None:
        yield (
            "deadman",
            Part(route.deadman.span, f"after {duration(route.deadman.timeout.value)}", _deadman(route.deadman)),
        )
    yield from _targets(checked.targets, route, "")
    for feed in checked.feeds:
        topic = feed.topic
        yield f"from topic {topic.topic.value}", Part(topic.span, topic.type.value, _topic(topic))
        yield from _targets(feed.targets, route, f" from topic {topic.topic.value}")


def _route_settings(route: Route) -> dict[str, str]:
    settings = {
        "source": ", ".join(source.value for source in route.sources),
        **flat(route.ttl, "ttl"),
        **flat(route.priority, "priority"),
        **flat(route.for_each, "for_each"),
        **flat(route.collect, "collect"),
        **flat(route.ignore, "ignore"),
        **flat(route.no_deadman, "no_deadman"),
    }
    return {name: text for name, text in settings.items() if text}


def _deadman(deadman: Deadman) -> dict[str, str]:
    return {
        "timeout": duration(deadman.timeout.value),
        "repeat": duration(deadman.repeat.value),
        "send": f"{{{deadman.case.value}: {field_map(deadman.fields)}}}",
        "to": ", ".join(endpoint.value for endpoint in deadman.to),
        "hands_over_to": ", ".join(case.value for case in deadman.hands_over_to) or NONE,
        "at_start": _at_start(deadman),
    }


def _at_start(deadman: Deadman | InboundDeadman) -> str:
    return "send" if deadman.at_start else "silent"


def _targets(targets: Iterable[CheckedTarget], route: Route, origin: str) -> Iterator[tuple[str, Part]]:
    for served in targets:
        name = served.target.name
        mapping = {row.target: row.expression for row in served.rows}
        if served.topic is not None:
            topic = served.topic
            yield f"topic {name}{origin}", Part(topic.span, topic.type.value, {**_topic(topic), **mapping})
        else:
            named = next(each for each in route.destinations if each.endpoint.value == name)
            yield f"destination {name}{origin}", Part(named.span, "", {**_conditions(named), **mapping})


def _gateway_parts(gateway: Gateway) -> Iterator[tuple[str, Part]]:
    yield "", Part(gateway.span, gateway.transport.value.value, _gateway_settings(gateway))
    for inbound in gateway.inbound:
        settings = {**_topic(inbound.topic), **flat(inbound.ttl, "ttl")}
        if (deadman := inbound.deadman) is not None:
            keys = {"timeout": deadman.timeout, "send": deadman.fields, "repeat": deadman.repeat}
            settings |= flat(keys, "deadman") | {"deadman.at_start": _at_start(deadman)}
        yield f"inbound {inbound.topic.topic.value}", Part(inbound.span, inbound.topic.type.value, settings)


def _gateway_settings(gateway: Gateway) -> dict[str, str]:
    keys = {"include": "topics.include", "exclude": "topics.exclude", "compression": "compression.zstd"}
    zenoh = gateway.zenoh
    settings = flat(replace(gateway, inbound=(), zenoh=replace(zenoh, config=None) if zenoh else None))
    if not gateway.compression:
        del settings["compression"]
    if zenoh and zenoh.config:
        # Different for different configurations, and tells nothing of what is in them: it may be secret.
        settings["zenoh.config"] = f"{zenoh.config.path or 'here'} ({hash(zenoh.config.text) & 0xFFFFFF:06x})"
    return {keys.get(key, key): text for key, text in settings.items()}


def _topic(topic: Topic) -> dict[str, str]:
    """The whole quality of service is compared, in whichever words the table asks for it."""
    return {"type": topic.type.value, **flat(asdict(qos_of(topic)), "qos"), **_conditions(topic)}


def _conditions(target: Destination | Topic) -> dict[str, str]:
    return {**flat(target.when, "when"), **flat(target.keep, "keep"), **flat(target.max_rate, "max_rate")}
