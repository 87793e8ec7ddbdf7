"""The Grafana dashboard of `deploy/grafana`, read for tests."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

DASHBOARD = Path(__file__).parents[2] / "deploy/grafana/rover-router.json"

Json = dict[str, Any]


def dashboard() -> Json:
    found: Json = json.loads(DASHBOARD.read_text(encoding="utf-8"))
    return found


def panels(row: str | None = None) -> Iterator[Json]:
    """All panels with data, or those of one row. The panels of an open row follow it."""
    title = ""
    for panel in dashboard()["panels"]:
        if panel["type"] == "row":
            title, shown = panel["title"], panel["panels"]
        else:
            shown = [panel]
        if row in (None, title):
            yield from shown


def queries(values: Mapping[str, str], row: str | None = None) -> list[str]:
    """The expressions of `panels(row)`, with `$name` replaced by the value of that name."""
    found = [target["expr"] for panel in panels(row) for target in panel["targets"]]
    for name, value in values.items():
        found = [expression.replace(f"${name}", value) for expression in found]
    return found
