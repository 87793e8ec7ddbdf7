"""Results as tables for people. Knows nothing but the file's contents."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from textwrap import fill
from typing import Any

NOTES = {"noise": (0.05, "noisy"), "generator_gave_up": (0.0, "at least")}
"""What to say of a contender in whose rounds such a metric was above a limit: others took so much of a core; a faster
generator might have found more."""

HEADINGS = ("figure", "measured", "other", "measured / other", "range", "aim", "", "notes")

WIDTH = 118


def number(value: float) -> str:
    return f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"


def notes(contenders: Mapping[str, Any]) -> str:
    found = (
        f"{name} {note}"
        for name, metrics in contenders.items()
        for metric, (limit, note) in NOTES.items()
        if metric in metrics and metrics[metric]["max"] > limit
    )
    return ", ".join(found)


def cells(entry: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """One row for each figure of a scenario, as HEADINGS say."""
    contenders = entry["contenders"]
    for figure in entry["figures"]:
        metric, of, against = figure["metric"], figure["of"], figure["against"]
        shown = {name: contenders[name] for name in (of, against) if name}
        yield (
            metric,
            f"{of} {number(contenders[of][metric]['median'])}",
            f"{against} {number(contenders[against][metric]['median'])}" if against else "",
            f"{figure['median']:.2f}" if against else "",
            f"{number(figure['min'])} to {number(figure['max'])}",
            figure["aim"],
            figure["verdict"],
            notes(shown),
        )


def text(name: str, entry: Mapping[str, Any]) -> str:
    """One scenario, for a terminal."""
    rows = [HEADINGS, *cells(entry)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(HEADINGS))]
    lines = ("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows)
    return "\n".join((f"{name}: {entry['title']}", *(f"  {line}" for line in lines)))


def page(results: Mapping[str, Any]) -> str:
    """All scenarios, as the body of a page of docs/."""
    lines: list[str] = []
    for name, entry in results["scenarios"].items():
        rounds = f"Medians of {entry['repeat']} fresh processes, {entry['date']}, commit {entry['commit']}."
        on = entry["machine"]
        machine = f"{on['cpu']}, {on['cores']} cores, Linux {on['linux']}, Python {on['python']}."
        lines += ["", f"## `{name}`", "", fill(f"{entry['title']}. {rounds} {machine}", WIDTH), ""]
        lines += [f"| {' | '.join(row)} |" for row in (HEADINGS, ("---",) * len(HEADINGS), *cells(entry))]
    return "\n".join([*lines[1:], ""])
