"""A new message in route tables: a stanza as its neighbours have it, where a person would put it.

Adds lines to the text; what stands there, comments and layout, stays as it is.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from router.table.model import ANY, EndpointKind, Route, RouteTable
from router.tools.new_message import NewMessage

_WIDEST = 120
_SECTION_WIDTH = 115
_ONE_LINE = re.compile(r"(?P<indent> *)[\w]+:(?P<gap> +)(?P<rest>\{.*\}) *$")


@dataclass(frozen=True, slots=True)
class _Stanza:
    """A route's lines in a file: `first` is that of its payload case, `end` the one behind its last; from 0."""

    first: int
    end: int
    indent: int


def board_table_text(text: str, message: NewMessage, table: RouteTable, file: str, package: str) -> str:
    """The table with a route from the board to ROS, and to the basestation, after the last route of that board."""
    lines = text.split("\n")
    own = [route for route in table.routes if route.span.file == file]
    of_board = [route for route in own if message.board in (source.value for source in route.sources)]
    stanza = _last(of_board or own, lines)
    indent = " " * stanza.indent
    written = ["", *(indent + line for line in _route(message, table, package, stanza.indent))]
    if not of_board:
        written[:0] = ["", f"{indent}# ---- {message.board_words} ".ljust(_SECTION_WIDTH, "-")]
    return "\n".join([*lines[: stanza.end], *written, *lines[stanza.end :]])


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


def _forwarding(route: Route) -> tuple[tuple[str, ...], tuple[str, ...]]:
    sources = tuple(source.value for source in route.sources)
    return sources, tuple(destination.endpoint.value for destination in route.destinations)


def _route(message: NewMessage, table: RouteTable, package: str, indent: int) -> list[str]:
    told = [
        name
        for name, endpoint in table.endpoints.items()
        if endpoint.kind is EndpointKind.BASESTATION and name != message.board
    ]
    destinations = [f"  destinations: [{', '.join(told)}]"] if told else []
    topics = _topics(message, package, _WIDEST - indent)
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


def _last(routes: Sequence[Route], lines: Sequence[str]) -> _Stanza:
    first = max(route.case.span.line for route in routes) - 1
    indent = _indent(lines[first])
    end = first + 1
    while end < len(lines) and (_says_nothing(lines[end]) or _indent(lines[end]) > indent):
        end += 1
    while _says_nothing(lines[end - 1]):  # what stands above the next route belongs to that
        end -= 1
    return _Stanza(first, end, indent)


def _says_nothing(line: str) -> bool:
    return not line.strip() or line.lstrip().startswith("#")


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip())
