"""What `router top` shows of a running router: its rows with ages and latencies, in the order that is asked for.

Two snapshots of the metrics in, rows out. Knows neither HTTP nor terminals (see `live`, `top_view`).
"""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from router.tools.live import BUCKETS, Counts, RouteRow, Snapshot, View, view

_HISTOGRAM = f"route_duration_seconds{BUCKETS}"


class Order(enum.Enum):
    """By what rows are sorted, and the key that chooses it. All but TABLE have the largest first."""

    TABLE = "table"
    RATE = "rate"
    DROPS = "drops"
    AGE = "age"
    LATENCY = "latency"

    @property
    def key(self) -> str:
        return self.value[0]


@dataclass(frozen=True, slots=True)
class TopRow:
    """`age` is the time since the route's last message, `median` and `slowest` (of 100 messages) its latency; seconds.

    None where there is none yet. `is_tripped` says that its deadman sends now.
    """

    row: RouteRow
    age: float | None
    median: float | None
    slowest: float | None
    is_tripped: bool


@dataclass(frozen=True, slots=True)
class Top:
    """`silence` is the time since each endpoint sent, None for never; seconds."""

    view: View
    rows: tuple[TopRow, ...]
    silence: Mapping[str, float | None]


def top(before: Snapshot, after: Snapshot, now: float, order: Order = Order.TABLE) -> Top:
    """`now` in seconds since 1970, as the stamps in the metrics."""
    seen = view(before, after)
    rows = tuple(_row(row, before, after, now) for row in seen.routes)
    stamps = after.counts("endpoint_last_seen_timestamp_seconds")
    silence = {labels[0]: _since(stamp, now) for labels, stamp in stamps.items()}
    return Top(seen, ordered(rows, order), silence)


def ordered(rows: Sequence[TopRow], order: Order) -> tuple[TopRow, ...]:
    """The largest first, what has no value last; those that are equal stay in the order of the table."""
    if order is Order.TABLE:
        return tuple(rows)
    return tuple(sorted(rows, key=lambda row: -_weight(row, order)))


def _weight(row: TopRow, order: Order) -> float:
    if order is Order.RATE:
        return row.row.rate
    if order is Order.DROPS:
        return sum(row.row.lost.values())
    value = row.age if order is Order.AGE else row.slowest
    return value if value is not None else -1.0


def _row(row: RouteRow, before: Snapshot, after: Snapshot, now: float) -> TopRow:
    counts = _since_then(_buckets(row.route, before), _buckets(row.route, after))
    return TopRow(
        row=row,
        age=_since(after.counts("route_last_message_timestamp_seconds").get((row.route,), 0.0), now),
        median=quantile(counts, 0.5),
        slowest=quantile(counts, 0.99),
        is_tripped=bool(after.counts("deadman_active").get((row.route,))),
    )


def _since(stamp: float, now: float) -> float | None:
    return max(now - stamp, 0.0) if stamp else None


def _buckets(route: str, snapshot: Snapshot) -> dict[float, float]:
    counts: Counts = snapshot.counts(_HISTOGRAM)
    return {float(bound): count for (name, bound), count in counts.items() if name == route}


def _since_then(before: Mapping[float, float], after: Mapping[float, float]) -> Mapping[float, float]:
    """What came in between; all that there was where nothing did, and where the router was started anew."""
    between = {bound: count - before.get(bound, 0.0) for bound, count in after.items()}
    return between if between.get(math.inf, 0.0) > 0 and min(between.values()) >= 0 else after


def quantile(counts: Mapping[float, float], part: float) -> float | None:
    """The value below which that part of all is, of how many are not above each bound; within a bucket by its length.

    `inf` where it is beyond the last bound, None where there is nothing.
    """
    bounds = sorted(counts)
    if not bounds or counts[bounds[-1]] <= 0:
        return None
    wanted = part * counts[bounds[-1]]
    lower, below = 0.0, 0.0
    for bound in bounds:
        if counts[bound] >= wanted:
            inside = counts[bound] - below
            return lower + (bound - lower) * (wanted - below) / inside if math.isfinite(bound) and inside else bound
        lower, below = bound, counts[bound]
    return math.inf
