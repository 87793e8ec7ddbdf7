"""A new message in route tables: a stanza as its neighbours have it, where a person would put it.

Adds lines to the text; what stands there, comments and layout, stays as it is.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from router.table.model import ANY, EndpointKind, Route, RouteTable
from router.tools.new_message_layout import WIDEST, Stanza, stanza_at, with_stanza_after
from router.tools.new_message_model import NewMessage

_ONE_LINE = re.compile(r"(?P<indent> *)[\w]+:(?P<gap> +)(?P<rest>\{.*\}) *$")


def board_table_text(text: str, message: NewMessage, table: RouteTable, file: str, package: str) -> str:
    """The table with a route from the board to ROS, and to the basestation, after the last route of that board."""
    lines = text.split("\n")
    own = [route for route in table.routes if route.span.file == file]
    of_board = [route for route in own if message.board in (source.value for source in route.sources)]
    stanza = _last(of_board or own, lines)
    route = _route(message, table, package, stanza.indent)
    return with_stanza_after(lines, stanza, route, "" if of_board else message.board_words)


def forwarding_table_text(text: str, message: NewMessage, table: RouteTable, file: str) -> str | None:
    """A table that sends everything to the same endpoints, with the new case among it. None where it does not."""
    lines = text.split("\n")
    own = [route for route in table.routes if route.span.file == file]
    if not own or len({_forwarding(route) for route in table.routes}) != 1 or _forwarding(own[0])[0] != (ANY,):
        return None
    stanza = _last(own, lines)
    template = _ONE_LINE.match(lines[stanza.first])
    if template is None:
        return None
    column = len(lines[stanza.first]) - len(lines[stanza.first].lstrip()) + lines[stanza.first].strip().index("{")
    key = f"{template['indent']}{message.case}:"
    line = f"{key.ljust(column - 1)} {template['rest']}"
    return "\n".join([*lines[: stanza.end], line, *lines[stanza.end :]])


def told_endpoints(message: NewMessage, table: RouteTable) -> list[str]:
    """Who gets everything that a board says: those that are basestations."""
    endpoints = table.endpoints.items()
    return [name for name, each in endpoints if each.kind is EndpointKind.BASESTATION and name != message.board]


def _forwarding(route: Route) -> tuple[tuple[str, ...], tuple[str, ...]]:
    sources = tuple(source.value for source in route.sources)
    return sources, tuple(destination.endpoint.value for destination in route.destinations)


def _route(message: NewMessage, table: RouteTable, package: str, indent: int) -> list[str]:
    told = told_endpoints(message, table)
    destinations = [f"  destinations: [{', '.join(told)}]"] if told else []
    topics = _topics(message, package, WIDEST - indent)
    return [f"{message.case}:", f"  source: {message.board}", *destinations, *topics]


def _topics(message: NewMessage, package: str, width: int) -> list[str]:
    """On as few lines as there can be."""
    keys = [f"topic: {message.case}", f"type: {package}/msg/{message.name}", "queue_depth: 10", "fields: auto"]
    topic = f"{{{', '.join(keys)}}}"
    in_one_line = f"  topics: [{topic}]"
    if len(in_one_line) <= width:
        return [in_one_line]
    in_two_lines = f"    - {topic}"
    if len(in_two_lines) <= width:
        return ["  topics:", in_two_lines]
    return ["  topics:", f"    - {keys[0]}", *(f"      {key}" for key in keys[1:])]


def _last(routes: Sequence[Route], lines: Sequence[str]) -> Stanza:
    return stanza_at(lines, max(route.case.span.line for route in routes) - 1)
