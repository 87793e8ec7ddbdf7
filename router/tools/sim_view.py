"""The simulator's statistics as a table for a terminal, as lines for a log, and as JSON."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterator
from typing import Any

from rich.table import Table
from rich.text import Text

from router.datagrams import Wire
from router.tools.board import Arrivals, Change, State
from router.tools.simulator import Statistics
from router.values.printing import compact, protobuf_json, rate_text

DIGITS = 4

RATE_WINDOW = 3.0
"""Seconds; with a shorter window the rate of slow streams flickers."""

Key = tuple[str, str]
"""Endpoint and payload case."""

PATIENCE = 2.0
"""Seconds without an answer after which the headline asks whether the router runs."""

_STYLES = {
    State.WAITING: "dim",
    State.OBEYING: "green",
    State.HALTED: "bold yellow",
    State.STOPPED: "bold red",
    State.CONTINUING: "bold red",
}


class SimView:
    """A read-only view of one simulator's statistics; keeps earlier counts for the rates."""

    def __init__(self, wire: Wire, statistics: Statistics) -> None:
        self._wire = wire
        self._statistics = statistics
        self._history: deque[tuple[float, dict[Key, int]]] = deque([(0.0, {})])
        self._rates: dict[Key, float] = {}

    def update(self, seconds: float) -> None:
        """Compute the rates over the last RATE_WINDOW seconds, or since the last update; `seconds` since the start."""
        counts = {key: arrivals.count for key, arrivals in self._arrivals()}
        while len(self._history) > 1 and seconds - self._history[1][0] >= RATE_WINDOW:
            self._history.popleft()
        before_at, before = self._history[0]
        self._rates = {key: (count - before.get(key, 0)) / (seconds - before_at) for key, count in counts.items()}
        self._history.append((seconds, counts))

    def _arrivals(self) -> Iterator[tuple[Key, Arrivals]]:
        for endpoint, inbox in self._statistics.inboxes.items():
            for case, arrivals in inbox.arrivals.items():
                yield (endpoint, case), arrivals

    @property
    def _seconds(self) -> float:
        return self._history[-1][0]

    def changes(self, since: float) -> list[Change]:
        """Changes of the boards' states after `since`, seconds since the start."""
        return [change for change in self._statistics.changes if change.at > since]

    def headline(self) -> str:
        """Return what went out and what was received, in one line."""
        statistics = self._statistics
        sent = sum(cases.total() for cases in statistics.sent.values())
        received = sum(arrivals.count for _, arrivals in self._arrivals())
        line = f"{self._seconds:.0f} s: sent {sent}, received {received}"
        if sent and not received and statistics.is_answered and self._seconds > PATIENCE:
            line += " (is the router running with this table?)"
        if statistics.unsent:
            line += f", not sent {statistics.unsent}"
        if undecodable := sum(inbox.undecodable for inbox in statistics.inboxes.values()):
            line += f", undecodable {undecodable}"
        return line

    def line(self) -> str:
        """Return the headline, and what each endpoint received."""
        counts: dict[str, int] = defaultdict(int)
        rates: dict[str, float] = defaultdict(float)
        for (endpoint, case), count in self._history[-1][1].items():
            counts[endpoint] += count
            rates[endpoint] += self._rates[endpoint, case]
        parts = [f"{endpoint} {counts[endpoint]} ({rate_text(rates[endpoint])}/s)" for endpoint in sorted(counts)]
        parts += [f"{endpoint} {text}" for endpoint, text, _ in self._statuses()]
        return self.headline() + (f"; {', '.join(parts)}" if parts else "")

    def _statuses(self) -> Iterator[tuple[str, str, str]]:
        """Yield each endpoint, its status in words, and the style of the status."""
        for endpoint, inbox in self._statistics.inboxes.items():
            if inbox.board is not None:
                yield endpoint, inbox.board.status(self._seconds), _STYLES[inbox.board.state]
                if ignored := inbox.board.ignored:
                    counts = ", ".join(f"{count} {case}" for case, count in ignored.items())
                    yield endpoint, f"ignored what it does not obey: {counts}", "bold red"
            for case, frames in inbox.frames.items():
                text = f"{case}: {frames.complete} frames complete, {frames.incomplete} incomplete"
                if frames.astray:
                    text += f", {frames.astray} parts of no frame"
                yield endpoint, text, "yellow" if frames.incomplete or frames.astray else "green"
            if inbox.undecodable:
                yield endpoint, f"{inbox.undecodable} undecodable datagrams", "bold red"

    def statuses(self) -> Table:
        """Return the boards' states and the basestation's frames, one line each."""
        table = Table(box=None, pad_edge=False, show_header=False, expand=True)
        table.add_column(no_wrap=True)
        table.add_column(no_wrap=True, ratio=1, overflow="ellipsis")
        for endpoint, text, style in self._statuses():
            table.add_row(Text(endpoint, style="cyan"), Text(text, style=style))
        return table

    def table(self, height: int) -> Table:
        """Return one line for each endpoint and payload case, at most `height` with the header; boards first."""
        table = Table(box=None, pad_edge=False, expand=True, header_style="bold")
        table.add_column("endpoint", no_wrap=True)
        table.add_column("received", no_wrap=True)
        table.add_column("count", justify="right", no_wrap=True)
        table.add_column("/s", justify="right", no_wrap=True)
        table.add_column("age", justify="right", no_wrap=True)
        table.add_column("last value", no_wrap=True, ratio=1, overflow="ellipsis")
        rows = sorted(self._arrivals(), key=lambda row: (self._statistics.inboxes[row[0][0]].board is None, row[0]))
        shown = rows if len(rows) < height else rows[: max(height - 2, 0)]
        for (endpoint, case), arrivals in shown:
            rate = self._rates.get((endpoint, case), 0.0)
            last = Text(compact(arrivals.last, self._wire.case(case).type, digits=DIGITS), style="dim")
            age = f"{self._seconds - arrivals.at:.1f}"
            table.add_row(Text(endpoint, style="cyan"), case, str(arrivals.count), rate_text(rate), age, last)
        if len(shown) < len(rows):
            table.add_row(Text(f"and {len(rows) - len(shown)} more", style="dim"))
        return table

    def as_json(self, seconds: float, final: bool) -> dict[str, Any]:
        """Return all statistics; payloads in protobuf's JSON mapping with the names of the `.proto` files.

        Times and ages in seconds. `boards` are the states, `changes` their history, the newest last, and `ignored` the
        counts of what boards do not obey.
        """
        inboxes = self._statistics.inboxes
        received: dict[str, dict[str, Any]] = defaultdict(dict)
        for (endpoint, case), arrivals in self._arrivals():
            last = protobuf_json(arrivals.last)
            age = round(seconds - arrivals.at, 3)
            received[endpoint][case] = {"count": arrivals.count, "age": age, "last": last}
        return {
            "seconds": round(seconds, 3),
            "final": final,
            "sent": self._statistics.sent,
            "unsent": self._statistics.unsent,
            "received": received,
            "undecodable": {name: inbox.undecodable for name, inbox in inboxes.items() if inbox.undecodable},
            "ignored": {
                name: inbox.board.ignored for name, inbox in inboxes.items() if inbox.board and inbox.board.ignored
            },
            "boards": {name: inbox.board.state.value for name, inbox in inboxes.items() if inbox.board},
            "frames": {
                name: {
                    case: {"complete": frames.complete, "incomplete": frames.incomplete, "astray": frames.astray}
                    for case, frames in inbox.frames.items()
                }
                for name, inbox in inboxes.items()
                if inbox.frames
            },
            "changes": [
                {"at": round(change.at, 3), "board": change.board, "state": change.state.value, "text": change.text}
                for change in self._statistics.changes
            ],
        }
