"""What the status page asks for: the map of the running table, its numbers, and the last values, as JSON.

Knows no HTTP.
"""

from __future__ import annotations

from typing import Any

from router.clock import wall_ns
from router.errors import shown_path
from router.observe.last_values import LastValues
from router.observe.route_map import NARROW, WIDE, Measures, RouteMap, route_map
from router.observe.running import Running
from router.observe.status_numbers import numbers

MEASURES: dict[str, Measures] = {
    "narrow": NARROW._replace(letters=17, letter=5.5),
    "wide": WIDE._replace(width=880, letters=30, pad=22),
}
"""In wide boxes there is room for a number beside the name."""


class Status:
    """Any thread may ask. Times are seconds of the router's wall clock."""

    def __init__(self, running: Running) -> None:
        self._running = running
        self._started = wall_ns() / 1e9
        self._values = LastValues(running)

    def numbers(self) -> dict[str, Any]:
        """Everything that changes; `map` says to which map it belongs, which changes with the table.

        `started` is different for each run of the router: counters begin again there.
        """
        running = self._running
        program = running.program
        table = program.table
        found = numbers(running.samples())
        for name, endpoint in table.endpoints.items():
            patience = endpoint.stale_after
            found["endpoints"].setdefault(name, {})["stale_after"] = None if patience is None else patience / 1e9
        return {
            "at": wall_ns() / 1e9,
            "started": self._started,
            "map": table.sha256,
            "table": shown_path(table.path),
            "ready": running.is_ready,
            **found,
            "values": self._values.of(program),
        }

    def map(self, width: str) -> dict[str, Any]:
        """The drawing, of a width of MEASURES. Raises KeyError for another."""
        table = self._running.program.table
        return {"map": table.sha256, **_as_json(route_map(table, MEASURES[width]))}

    def close(self) -> None:
        self._values.close()


def _as_json(drawing: RouteMap) -> dict[str, Any]:
    nodes = [
        {
            "key": node.part.key,
            "column": node.part.column,
            "kind": node.part.kind.value,
            "name": node.part.name,
            "about": node.part.about,
            "label": node.label,
            "box": [node.x, node.y, node.width, node.height],
        }
        for node in drawing.nodes
    ]
    links = [
        {
            "start": link.tie.start,
            "end": link.tie.end,
            "route": link.tie.route,
            "label": link.tie.label,
            "about": link.tie.about,
            "path": link.path,
        }
        for link in drawing.links
    ]
    measures = drawing.measures
    return {
        "size": [drawing.width, drawing.height],
        "columns": drawing.columns,
        "font": measures.font,
        "pad": measures.pad,
        "head": measures.head,
        "port": measures.port,
        "rates": measures.pad > NARROW.pad,
        "nodes": nodes,
        "links": links,
    }
