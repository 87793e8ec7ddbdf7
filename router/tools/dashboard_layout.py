"""Rows of panels, as the JSON that Grafana imports: its classic dashboard model. Knows nothing of what is shown."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from router.tools.dashboard_panels import Json, Panel, Query

SOURCE: Json = {"type": "prometheus", "uid": "${datasource}"}
"""The Prometheus that is chosen on top of the dashboard."""

WIDTH = 24
"""Columns of a dashboard."""

Column = Sequence[Panel]
"""Panels of one width, one below the other."""


def row(title: str, ids: Iterator[int], top: int, columns: Iterable[Column], *, is_open: bool) -> list[Json]:
    """A row that starts at line `top`: itself and its panels. One that is closed asks Prometheus for nothing."""
    head: Json = {
        "id": next(ids),
        "type": "row",
        "title": title,
        "collapsed": not is_open,
        "gridPos": {"h": 1, "w": WIDTH, "x": 0, "y": top},
        "panels": [],
    }
    placed = [_panel(panel, next(ids), x, y) for panel, x, y in _places(columns, top + 1)]
    if is_open:
        return [head, *placed]
    return [{**head, "panels": placed}]


def bottom(panels: Iterable[Json]) -> int:
    """The first line below them. What is in a closed row takes no room."""
    return max((each["gridPos"]["y"] + each["gridPos"]["h"] for each in panels), default=0)


def _places(columns: Iterable[Column], top: int) -> Iterator[tuple[Panel, int, int]]:
    """Columns side by side, as many as fit, then the next ones below them. Gives x and y of each panel."""
    x, y, tallest = 0, top, 0
    for column in columns:
        width = column[0].width
        if x + width > WIDTH:
            x, y, tallest = 0, y + tallest, 0
        below = y
        for panel in column:
            yield panel, x, below
            below += panel.height
        x, tallest = x + width, max(tallest, below - y)


def _panel(panel: Panel, number: int, x: int, y: int) -> Json:
    placed: Json = {
        "id": number,
        "type": panel.kind,
        "title": panel.title,
        "datasource": SOURCE,
        "gridPos": {"h": panel.height, "w": panel.width, "x": x, "y": y},
        "targets": [_target(panel, query, chr(ord("A") + index)) for index, query in enumerate(panel.queries)],
        **panel.body,
    }
    config = panel.body["fieldConfig"]
    placed["fieldConfig"] = {**config, "defaults": {**config["defaults"], "unit": panel.unit}}
    return {**placed, "description": panel.note} if panel.note else placed


def _target(panel: Panel, query: Query, name: str) -> Json:
    return {
        "refId": name,
        "datasource": SOURCE,
        "editorMode": "code",
        "expr": query.expr,
        "format": panel.format,
        "instant": panel.kind == "stat",
        "range": panel.kind != "stat",
        "legendFormat": query.legend,
    }
