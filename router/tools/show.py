"""The entries of a recording in the order of time, and the parts of it that `router show` is asked for."""

from __future__ import annotations

import datetime as dt
import heapq
import re
from collections.abc import Iterable, Iterator

from router.errors import UsageError
from router.recording.reader import Recorded, RecordedAction
from router.tools.tap import local_time

Entry = Recorded | RecordedAction

_DISORDER = 1_000_000_000
"""ns by which entries of a recording may be out of order, at most; the mirror's PERIOD is much shorter."""

_TIME_OF_DAY = re.compile(r"(\d{1,2}):(\d\d)(?::(\d\d)(\.\d+)?)?")
_SECONDS = re.compile(r"\d:\d\d:\d\d")


def in_order(entries: Iterable[Entry]) -> Iterator[Entry]:
    """Yield the entries in the order of time, without steps of the wall clock."""
    waiting: list[tuple[int, int, Entry]] = []
    for number, entry in enumerate(entries):
        heapq.heappush(waiting, (entry.steady, number, entry))
        while entry.steady - waiting[0][0] > _DISORDER:
            yield heapq.heappop(waiting)[-1]
    while waiting:
        yield heapq.heappop(waiting)[-1]


def window(around: str, margin: float, first: int) -> tuple[int, int]:
    """Return begin and end (ns) of the time `around`, with `margin` seconds before and after it.

    It is a local time of day, or a date and time. Without seconds it is a whole minute. A time of day is the next one
    after `first`, the beginning of the recording (ns). Raises UsageError.
    """
    begin = local_time(first)
    try:
        if (found := _TIME_OF_DAY.fullmatch(around)) is not None:
            hour, minute, second = (int(part or 0) for part in found.groups()[:3])
            at = begin.replace(hour=hour, minute=minute, second=second, microsecond=0)
            has_seconds = found[3] is not None
            if at + dt.timedelta(minutes=1) < begin - dt.timedelta(seconds=margin):
                at += dt.timedelta(days=1)
        else:
            at = dt.datetime.fromisoformat(around.removesuffix("Z") + "+00:00" * around.endswith("Z")).astimezone()
            has_seconds = _SECONDS.search(around) is not None
    except ValueError:
        how = "give a local time such as 14:03 or 14:03:07, or a date and time such as 2026-04-12T14:03:07"
        raise UsageError(f"--around: '{around}' is not a time", how) from None
    start = int(at.timestamp() * 1e9)
    extra = int(margin * 1e9)
    return start - extra, start + (1 if has_seconds else 60) * 1_000_000_000 + extra
