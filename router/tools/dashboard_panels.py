"""Kinds of panels of a Grafana dashboard, with the options that it reads. Knows no metric, and no panel's place."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

Json = dict[str, Any]

RED, GREEN = "red", "green"

MESSAGES, BYTES, SECONDS = "mps", "Bps", "s"
"""Units: per second the first two."""

LOST = "/^(dropped|rejected|lost)/"
"""What is called so is red."""

DEADMAN = {"0": ("quiet", GREEN), "1": ("sends", RED)}
"""What the values of a deadman's state mean."""


@dataclass(frozen=True, slots=True)
class Query:
    """PromQL, and what its series are called: `{{label}}` stands for a label's value."""

    expr: str
    legend: str


@dataclass(frozen=True, slots=True)
class Panel:
    """A panel without its place. `body` is what it has beyond title, queries and unit."""

    title: str
    kind: str
    queries: tuple[Query, ...]
    unit: str
    width: int
    height: int
    body: Json
    note: str = ""
    format: str = "time_series"


def lines(
    title: str, queries: Iterable[Query], unit: str, width: int, lost: str | None = None, note: str = ""
) -> Panel:
    """Lines over time. Series whose name matches the regular expression `lost` are red."""
    override = {
        "matcher": {"id": "byRegexp", "options": lost},
        "properties": [{"id": "color", "value": {"mode": "shades", "fixedColor": RED}}],
    }
    body = {
        "fieldConfig": {
            "defaults": {
                "color": {"mode": "palette-classic"},
                "custom": {"drawStyle": "line", "fillOpacity": 8, "lineWidth": 1, "showPoints": "never"},
                "min": 0,
            },
            "overrides": [override] if lost else [],
        },
        "options": {
            "legend": {"calcs": ["lastNotNull"], "displayMode": "list", "placement": "bottom", "showLegend": True},
            "tooltip": {"mode": "multi", "sort": "desc"},
        },
    }
    return Panel(title, "timeseries", tuple(queries), unit, width, 8, body, note)


def number(
    title: str,
    query: Query,
    unit: str,
    width: int,
    height: int,
    steps: Sequence[tuple[float | None, str]] = ((None, GREEN),),
    names: Mapping[str, tuple[str, str]] | None = None,
    empty: str = "-",
    note: str = "",
) -> Panel:
    """The latest value, coloured by `steps`: from which value on which colour. `names` are shown in place of values.

    `empty` is shown where there is no value.
    """
    body = {
        "fieldConfig": {
            "defaults": {
                "color": {"mode": "thresholds"},
                "mappings": _mappings(names or {}),
                "noValue": empty,
                "thresholds": {
                    "mode": "absolute",
                    "steps": [{"color": colour, "value": value} for value, colour in steps],
                },
            },
            "overrides": [],
        },
        "options": {
            "colorMode": "value",
            "graphMode": "none",
            "justifyMode": "auto",
            "orientation": "auto",
            "reduceOptions": {"calcs": ["lastNotNull"], "fields": "", "values": False},
            "textMode": "auto",
        },
    }
    return Panel(title, "stat", (query,), unit, width, height, body, note)


def states(title: str, queries: Iterable[Query], width: int, names: Mapping[str, tuple[str, str]], note: str) -> Panel:
    """A bar over time for each series; `names` has text and colour of each value."""
    body = {
        "fieldConfig": {
            "defaults": {
                "color": {"mode": "thresholds"},
                "custom": {"fillOpacity": 80, "lineWidth": 0},
                "mappings": _mappings(names),
                "thresholds": {"mode": "absolute", "steps": [{"color": GREEN, "value": None}]},
            },
            "overrides": [],
        },
        "options": {
            "alignValue": "left",
            "legend": {"displayMode": "list", "placement": "bottom", "showLegend": False},
            "mergeValues": True,
            "rowHeight": 0.8,
            "showValue": "never",
            "tooltip": {"mode": "single", "sort": "none"},
        },
    }
    return Panel(title, "state-timeline", tuple(queries), "none", width, 8, body, note)


def heat_map(title: str, query: Query, unit: str, width: int, note: str = "") -> Panel:
    """How many values of a histogram fell where, over time. `query` gives the buckets, named by their bounds."""
    body = {
        "fieldConfig": {"defaults": {"custom": {"scaleDistribution": {"type": "linear"}}}, "overrides": []},
        "options": {
            "calculate": False,
            "cellGap": 1,
            "color": {
                "exponent": 0.5,
                "fill": "dark-orange",
                "mode": "scheme",
                "reverse": False,
                "scale": "exponential",
                "scheme": "Oranges",
                "steps": 64,
            },
            "exemplars": {"color": "rgba(255,0,255,0.7)"},
            "filterValues": {"le": 1e-9},
            "legend": {"show": True},
            "rowsFrame": {"layout": "auto"},
            "tooltip": {"mode": "single", "showColorScale": False, "yHistogram": False},
            "yAxis": {"axisPlacement": "left", "reverse": False, "unit": unit},
        },
    }
    return replace(Panel(title, "heatmap", (query,), unit, width, 8, body, note), format="heatmap")


def _mappings(names: Mapping[str, tuple[str, str]]) -> list[Json]:
    options = {
        value: {"color": colour, "index": index, "text": text}
        for index, (value, (text, colour)) in enumerate(names.items())
    }
    return [{"type": "value", "options": options}] if options else []
