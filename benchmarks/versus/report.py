"""Results as a table for people. Knows nothing but the file's contents."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

NOISY = 0.05
"""Of a core that others took; where it was more in any round, the line says so."""

HEADINGS = ("figure", "router", "other", "ratio", "range", "aim", "")


def number(value: float) -> str:
    return f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"


def cells(entry: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """One row for each figure of a scenario, as HEADINGS say."""
    contenders = entry["contenders"]
    first = next(iter(contenders.values()))
    for figure in entry["figures"]:
        metric, against = figure["metric"], figure["against"]
        other = contenders[against][metric]["median"] if against else None
        noisy = max(metrics.get("noise", {"max": 0})["max"] for metrics in contenders.values()) > NOISY
        yield (
            metric,
            number(first[metric]["median"]),
            f"{against} {number(other)}" if other is not None else "",
            f"{figure['median']:.2f}" if against else "",
            f"{number(figure['min'])} to {number(figure['max'])}",
            figure["aim"],
            " ".join(filter(None, (figure["verdict"], "noisy" if noisy else ""))),
        )


def text(name: str, entry: Mapping[str, Any]) -> str:
    """One scenario, for a terminal."""
    rows = [HEADINGS, *cells(entry)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(HEADINGS))]
    lines = ("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows)
    return "\n".join((f"{name}: {entry['title']}", *(f"  {line}" for line in lines)))
