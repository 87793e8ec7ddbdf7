"""How the simulator's statistics look: a table for a terminal, lines for a log, JSON for programs.

Remembers the counts of the last looks, to tell rates.
"""

from __future__ import annotations

from collections import defaultdict, deque
from typing import Any

from google.protobuf.json_format import MessageToDict
from rich.table import Table
from rich.text import Text

from router.tools.show import compact, rate_text
from router.tools.simulator import Statistics
from router.tools.wire import Wire

DIGITS = 4

RATE_WINDOW = 3.0
"""Seconds; over less, one message in two seconds is no rate but a flicker."""

Counts = dict[tuple[str, str], int]

PATIENCE = 2.0
"""Seconds without an answer after which a missing router is the likely reason."""


class SimView:
    """Looks at one simulator's statistics, which it never changes."""

    def __init__(self, wire: Wire, statistics: Statistics) -> None:
        self._wire = wire
        self._statistics = statistics
        self._looks: deque[tuple[float, Counts]] = deque([(0.0, {})])
        self._rates: dict[tuple[str, str], float] = {}

    def look(self, seconds: float) -> None:
        """Compute the rates over the last RATE_WINDOW seconds, or since the last look; `seconds` since the start."""
        counts = {key: arrivals.count for key, arrivals in self._statistics.received.items()}
        while len(self._looks) > 1 and seconds - self._looks[1][0] >= RATE_WINDOW:
            self._looks.popleft()
        before_at, before = self._looks[0]
        self._rates = {key: (count - before.get(key, 0)) / (seconds - before_at) for key, count in counts.items()}
        self._looks.append((seconds, counts))

    def headline(self) -> str:
        """What went out and what came back, in one line."""
        statistics = self._statistics
        sent = sum(statistics.sent.values())
        received = sum(arrivals.count for arrivals in statistics.received.values())
        seconds = self._looks[-1][0]
        line = f"{seconds:.0f} s: sent {sent}, came back {received}"
        if not received and seconds > PATIENCE:
            line += " (is the router running with this table?)"
        if statistics.unsent:
            line += f", refused by the kernel {statistics.unsent}"
        if undecodable := sum(statistics.undecodable.values()):
            line += f", undecodable {undecodable}"
        return line

    def line(self) -> str:
        """The headline, and what each endpoint received."""
        counts: dict[str, int] = defaultdict(int)
        rates: dict[str, float] = defaultdict(float)
        for (endpoint, case), count in self._looks[-1][1].items():
            counts[endpoint] += count
            rates[endpoint] += self._rates[endpoint, case]
        parts = [f"{endpoint} {counts[endpoint]} ({rate_text(rates[endpoint])}/s)" for endpoint in sorted(counts)]
        return self.headline() + (f"; {', '.join(parts)}" if parts else "")

    def table(self, height: int) -> Table:
        """One line for each endpoint and payload case, at most `height` with the header."""
        table = Table(box=None, pad_edge=False, expand=True, header_style="bold")
        table.add_column("endpoint", no_wrap=True)
        table.add_column("received", no_wrap=True)
        table.add_column("count", justify="right", no_wrap=True)
        table.add_column("/s", justify="right", no_wrap=True)
        table.add_column("last value", no_wrap=True, ratio=1, overflow="ellipsis")
        rows = sorted(self._statistics.received.items())
        shown = rows if len(rows) < height else rows[: max(height - 2, 0)]
        for (endpoint, case), arrivals in shown:
            rate = self._rates.get((endpoint, case), 0.0)
            last = Text(compact(arrivals.last, self._wire.case(case).type, digits=DIGITS), style="dim")
            table.add_row(Text(endpoint, style="cyan"), case, str(arrivals.count), rate_text(rate), last)
        if len(shown) < len(rows):
            table.add_row(Text(f"and {len(rows) - len(shown)} more", style="dim"))
        return table

    def as_json(self, seconds: float, final: bool) -> dict[str, Any]:
        """All statistics; payloads in protobuf's JSON mapping with the names of the `.proto` files."""
        received: dict[str, dict[str, Any]] = defaultdict(dict)
        for (endpoint, case), arrivals in self._statistics.received.items():
            last = MessageToDict(arrivals.last, preserving_proto_field_name=True)
            received[endpoint][case] = {"count": arrivals.count, "last": last}
        return {
            "seconds": round(seconds, 3),
            "final": final,
            "sent": _nested(self._statistics.sent),
            "unsent": self._statistics.unsent,
            "received": received,
            "undecodable": self._statistics.undecodable,
        }


def _nested(counts: dict[tuple[str, str], int]) -> dict[str, dict[str, int]]:
    nested: dict[str, dict[str, int]] = defaultdict(dict)
    for (first, second), count in counts.items():
        nested[first][second] = count
    return nested
