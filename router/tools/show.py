"""What `router show` prints of a recording: what was received, decided and sent, in the order of time."""

from __future__ import annotations

import datetime as dt
import heapq
import json
import re
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass

from google.protobuf.json_format import MessageToDict

from router.datagrams import Decoded, Wire
from router.errors import DecodeError, UsageError
from router.recording.mirror import BRAKED, LOST, RELEASED, SENT, TRIPPED, Action
from router.recording.reader import Recorded, RecordedAction
from router.tools.tap import Condition, TappedDatagram, local_time, tapped_datagram, utc_text
from router.values import clock_text, compact

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


@dataclass(frozen=True, slots=True)
class ShownAction:
    """An action: its time (local time), and what it sent, if it did."""

    at: dt.datetime
    action: Action
    decoded: Decoded | None

    def line(self, with_hex: bool = False) -> str:
        """Return one line: `12:00:00.123+0200 sent to driving_board (drive from topic cmd): drive left=5`."""
        del with_hex  # nothing is shown in hexadecimal
        return f"{clock_text(self.at)} {self._what()}"

    def _what(self) -> str:
        it = self.action
        deadman = f"the deadman of {it.route}"
        if it.what == TRIPPED:
            return f"{deadman} tripped"
        if it.what == RELEASED:
            return f"{deadman} was released: a command was sent"
        source = f" from topic {it.topic}" if it.topic else ""
        if it.what == LOST:
            return f"not sent to {it.target} ({it.route}{source}): {self._why_not()}"
        by = deadman if it.what == BRAKED else f"{it.route}{source}"
        if it.reason:
            return f"not sent to {it.target} ({by}): {self._why_not()}"
        return f"sent to {it.target} ({by}): {self._payload()}"

    def _why_not(self) -> str:
        return ": ".join(filter(None, (self.action.reason, self.action.detail)))

    def _payload(self) -> str:
        if self.decoded is None:
            return f"undecodable: {self.action.data.hex()}"
        return f"{self.decoded.case.name} {compact(self.decoded.message, self.decoded.case.type)}".rstrip()

    def json(self, with_hex: bool = False) -> str:
        """Return one JSON object."""
        del with_hex
        it = self.action
        document: dict[str, object] = {"time": utc_text(self.at), "action": it.what, "route": it.route}
        texts = {"endpoint": it.target, "topic": it.topic, "reason": it.reason, "detail": it.detail}
        document |= {key: text for key, text in texts.items() if text}
        if self.decoded is not None:
            document["case"] = self.decoded.case.name
            document["fields"] = MessageToDict(self.decoded.message, preserving_proto_field_name=True)
        return json.dumps(document)


def shown(entry: Entry, wire: Wire) -> TappedDatagram | ShownAction:
    """Return an entry as it is printed."""
    if isinstance(entry, Recorded):
        peer = entry.endpoint or f"{entry.peer[0]}:{entry.peer[1]}"
        return tapped_datagram(entry.at, peer, entry.data, wire, entry.reason)
    action = entry.action
    try:
        decoded = wire.decode(action.data) if action.what in (SENT, BRAKED) and action.data else None
    except DecodeError:
        decoded = None
    return ShownAction(local_time(action.at), action, decoded)


class Filter:
    """Selects payloads of `cases` that fulfil `condition`; without either, everything."""

    def __init__(self, cases: Collection[str], condition: Condition | None) -> None:
        self._cases = cases
        self._condition = condition

    def takes(self, entry: Entry, as_shown: TappedDatagram | ShownAction) -> bool:
        if not self._cases and self._condition is None:
            return True
        if (decoded := as_shown.decoded) is None or (self._cases and decoded.case.name not in self._cases):
            return False
        sender = as_shown.peer if isinstance(as_shown, TappedDatagram) else ""
        return self._condition is None or self._condition.holds(decoded.case.name, decoded.message, sender, entry.at)
