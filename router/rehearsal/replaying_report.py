"""What a recording through two tables came to, in plain lines: counts by route and target, then fields that differ.

Knows types of payloads and topics; the comparison is done.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

from router.compiler import Checked
from router.engine.wire import Wire
from router.errors import DecodeError, MappingError
from router.rehearsal.events import Published, Sent
from router.rehearsal.places import Places
from router.rehearsal.replaying_against import Against, Delivery, Row
from router.rehearsal.replaying_flat import fields
from tests.oracles import reference_cdr

MOST_FIELDS = 12
MOST_SENDERS = 5
_COLUMNS = ("old", "new", "same", "changed", "moved", "lost", "added")


class _Told(NamedTuple):
    """A delivery as a person reads it: what it is, and its fields."""

    what: str
    fields: dict[str, str]


class Report:
    def __init__(self, old: Checked, new: Checked) -> None:
        self._tables = (old, new)
        self._places = (Places(old), Places(new))
        self._wires = tuple(Wire(checked.envelope) for checked in (old, new) if checked.envelope)

    def lines(self, found: Against) -> Iterator[str]:
        """All of it. Little where both tables deliver the same."""
        old, new = (checked.path for checked in self._tables)
        yield f"{found.datagrams} datagrams of {found.span / 1e9:.1f} s, through {old} and {new}"
        if not found.differs:
            yield f"both deliver the same, {sum(row.old for row in found.rows.values())} datagrams and messages"
            yield from _same_losses(found)
            yield from _strangers(found)
            return
        yield from self._counts(found)
        yield from self._losses(found)
        for (route, target), row in sorted(found.rows.items()):
            for at, before, after in row.examples:
                if _is_told(row, before, after):
                    yield ""
                    yield f"{route} to {target}, {at / 1e9:.3f} s after the beginning:"
                    yield from self._example(before, after)
        yield from _strangers(found)

    def _counts(self, found: Against) -> Iterator[str]:
        rows = {key: row for key, row in sorted(found.rows.items()) if row.differs}
        if not rows:
            return
        width = [max(map(len, column)) for column in zip(("route", "target"), *rows, strict=True)]
        yield ""
        yield f"{'route':{width[0]}}  {'target':{width[1]}}" + "".join(f"{name:>9}" for name in _COLUMNS)
        for (route, target), row in rows.items():
            counts = [getattr(row, name) for name in _COLUMNS]
            yield f"{route:{width[0]}}  {target:{width[1]}}" + "".join(f"{count:9}" for count in counts)

    def _losses(self, found: Against) -> Iterator[str]:
        old, new = found.losses
        changed = sorted(loss for loss in {*old, *new} if old[loss] != new[loss])
        if changed:
            yield ""
        for done, place, target, reason in changed:
            key = (done, place, target, reason)
            to = f" to {target}" if target else ""
            yield f"{done} ({reason}): {place}{to}: {old[key]} with the old table, {new[key]} with the new one"

    def _example(self, before: Delivery | None, after: Delivery | None) -> Iterator[str]:
        old = self._told(0, before) if before is not None else None
        new = self._told(1, after) if after is not None else None
        if old is None or new is None:
            told, which = (new, "new") if old is None else (old, "old")
            assert told is not None  # noqa: S101 - there is one of them
            shown = [f"{name}={value}" for name, value in told.fields.items()]
            yield f"  with the {which} table only: {told.what} {' '.join(shown[:MOST_FIELDS])}"
            return
        if old.what != new.what:
            yield f"  {old.what} became {new.what}"
        differing = [name for name in {**old.fields, **new.fields} if old.fields.get(name) != new.fields.get(name)]
        for name in differing[:MOST_FIELDS]:
            yield f"  {name}: {old.fields.get(name, 'nothing')} became {new.fields.get(name, 'nothing')}"
        if len(differing) > MOST_FIELDS:
            yield f"  and {len(differing) - MOST_FIELDS} more fields"
        if not differing and old.what == new.what:
            yield "  the same fields, in other bytes"

    def _told(self, side: int, event: Delivery) -> _Told:
        match event:
            case Published():
                kind = self._places[side].type(event.route, event.topic)
                if kind is None:
                    return _Told("a message", {"bytes": event.cdr.hex()})
                try:
                    return _Told(kind.name, fields(kind, reference_cdr.parse(kind, event.cdr)))
                except (MappingError, ValueError):
                    return _Told(kind.name, {"bytes": event.cdr.hex()})
            case Sent():
                try:
                    decoded = self._wires[side].decode(event.data)
                except DecodeError:
                    return _Told("a datagram", {"bytes": event.data.hex()})
                return _Told(decoded.case.name, fields(decoded.case.type, decoded.message))


def _same_losses(found: Against) -> Iterator[str]:
    """Of a recording that nobody takes, as on another network, the same is nothing."""
    counts: Counter[str] = Counter()
    for (done, _, _, reason), count in found.losses[0].items():
        counts[f"{done} ({reason})"] += count
    for what, count in sorted(counts.items()):
        yield f"{what}: {count} with both"


def _strangers(found: Against) -> Iterator[str]:
    """Why next to nothing was delivered, where the tables are for another network than the recording."""
    if not found.is_among_strangers:
        return
    named = sorted({f"{name or 'a stranger'} at {peer[0]}" for name, _, peer in found.senders})
    more = f" and {len(named) - MOST_SENDERS} more" if len(named) > MOST_SENDERS else ""
    yield ""
    yield f"neither table has an endpoint where the datagrams came from: {', '.join(named[:MOST_SENDERS])}{more};"
    yield "compare tables with the addresses of the recording"


def _is_told(row: Row, before: Delivery | None, after: Delivery | None) -> bool:
    """What only came at another time is no example of what did not come."""
    if before is None:
        return row.added > 0
    return after is not None or row.lost > 0
