"""Runs a recording through two tables on one clock, compares the deliveries, and reports those that differ."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import NamedTuple, Union

from router.compiler import Checked
from router.compiler.compiled_table import CompiledTable
from router.compiler.network import arrival
from router.compiler.resolution import names, resolved
from router.datagrams import Peer, Wire
from router.errors import DecodeError, MappingError
from router.recording.mirror import Classifier
from router.recording.reader import Recorded
from router.rehearsal import cdr
from router.rehearsal.describing import TableIndex
from router.rehearsal.fields import leaves
from router.rehearsal.rehearsal import Dropped, Event, Filtered, Published, Rehearsal, Rejected, Sent, Superseded

Delivery = Union[Sent, Published]
Loss = tuple[str, str, str, str]
"""What was done (dropped, withheld, rejected, superseded), where (a route or a listener), for which target, and why."""


@dataclass(slots=True)
class Row:
    """What one target got from one route. `moved`: delivered by both tables with the same bytes at different times.

    `examples`, one of each kind, have the nanoseconds since the beginning and each table's delivery, if there is one.
    """

    old: int = 0
    new: int = 0
    same: int = 0
    changed: int = 0
    moved: int = 0
    examples: list[tuple[int, Delivery | None, Delivery | None]] = field(default_factory=list)

    @property
    def lost(self) -> int:
        return self.old - self.same - self.changed - self.moved

    @property
    def added(self) -> int:
        return self.new - self.same - self.changed - self.moved

    @property
    def differs(self) -> bool:
        return not self.old == self.new == self.same


class Against:
    """The comparison. `take` the datagrams in order; `rows` are by route and target, `losses` by table.

    `span` is the time from the first datagram to the last, ns. `senders` are names in the recording, listeners, and
    addresses.
    """

    def __init__(self, old: CompiledTable, new: CompiledTable) -> None:
        self.rows: dict[tuple[str, str], Row] = {}
        self.losses: tuple[Counter[Loss], Counter[Loss]] = (Counter(), Counter())
        self.datagrams = 0
        self.span = 0
        self.senders: set[tuple[str, str, Peer]] = set()
        self._programs = [old, new]
        self._hosts: tuple[dict[str, str], ...] = ({}, {})
        """Addresses of host names, as in the recording."""
        self._runs: tuple[Rehearsal, ...] = ()
        self._first = self._start = 0
        self._unmatched: tuple[Counter[tuple[str, bytes]], ...] = (Counter(), Counter())
        """Deliveries that the other table has not made so far, by target and digest."""

    def take(self, datagram: Recorded) -> None:
        if not self._runs:
            self._first, self._start = datagram.steady, datagram.at
            self._runs = tuple(Rehearsal(program, datagram.at) for program in self._programs)
        self.datagrams += 1
        self.span = datagram.steady - self._first
        self.senders.add((datagram.endpoint, datagram.listener, datagram.peer))
        for side, run in enumerate(self._runs):
            run.advance(self._start + self.span)
            program = self._resolve(side, datagram)
            place = arrival(program.table, datagram.listener, datagram.peer, datagram.endpoint)
            if place is not None:
                run.datagram(*place, datagram.data)
            else:
                run.events.append(Rejected(run.now, datagram.listener, "no such listener"))
        old, new = (self._deliveries(side) for side in (0, 1))
        for target in dict.fromkeys((*old, *new)):
            self._compare(old.get(target, []), new.get(target, []))

    def _resolve(self, side: int, datagram: Recorded) -> CompiledTable:
        """Return the program of a side, after its endpoint with a host name has got the address of the sender."""
        program, hosts, (address, _) = self._programs[side], self._hosts[side], datagram.peer
        host = names(program).get(datagram.endpoint)
        if host is not None and hosts.get(host) != address:
            hosts[host] = address
            self._programs[side] = program = resolved(program, hosts)
            self._runs[side].reload(program)
        return program

    @property
    def differs(self) -> bool:
        return self.losses[0] != self.losses[1] or any(row.differs for row in self.rows.values())

    @property
    def is_among_strangers(self) -> bool:
        """Whether neither table has an endpoint for any sender."""
        tables = [Classifier(program.envelopes, program.table) for program in self._programs]
        places = {(listener, peer) for _, listener, peer in self.senders}
        return bool(places) and not any(table.sender(*place) for table in tables for place in places)

    def _deliveries(self, side: int) -> dict[str, list[Delivery]]:
        """Return deliveries since the last call, by target. Losses are counted."""
        deliveries: dict[str, list[Delivery]] = {}
        for event in self._runs[side].events:
            if isinstance(event, (Sent, Published)):
                deliveries.setdefault(event.target, []).append(event)
            elif (loss := _loss(event)) is not None:
                self.losses[side][loss] += 1
        self._runs[side].events.clear()
        return deliveries

    def _compare(self, old: Sequence[Delivery], new: Sequence[Delivery]) -> None:
        """Count what one target got from one datagram and in the time before it."""
        for delivery in old:
            self._row(delivery).old += 1
        for delivery in new:
            self._row(delivery).new += 1
        only_old = self._without_same(old, Counter(delivery.data for delivery in new), count=True)
        only_new = self._without_same(new, Counter(delivery.data for delivery in old), count=False)
        only_old = list(self._without_moved(only_old, self._unmatched[1]))
        only_new = list(self._without_moved(only_new, self._unmatched[0]))
        both = min(len(only_old), len(only_new))
        for before, after in zip(only_old[:both], only_new[:both], strict=True):
            self._row(after).changed += 1
            self._example(before, after)
        for delivery in only_old[both:]:
            self._unmatched[0][_key(delivery)] += 1
            self._example(delivery, None)
        for delivery in only_new[both:]:
            self._unmatched[1][_key(delivery)] += 1
            self._example(None, delivery)

    def _without_same(self, deliveries: Sequence[Delivery], others: Counter[bytes], *, count: bool) -> list[Delivery]:
        left = []
        for delivery in deliveries:
            if others[delivery.data]:
                others[delivery.data] -= 1
                self._row(delivery).same += count
            else:
                left.append(delivery)
        return left

    def _without_moved(self, left: Sequence[Delivery], unmatched: Counter[tuple[str, bytes]]) -> Iterator[Delivery]:
        """Yield deliveries without those that the other table made earlier."""
        for delivery in left:
            if unmatched[key := _key(delivery)]:
                unmatched[key] -= 1
                self._row(delivery).moved += 1
            else:
                yield delivery

    def _row(self, event: Delivery) -> Row:
        return self.rows.setdefault((event.route, event.target), Row())

    def _example(self, old: Delivery | None, new: Delivery | None) -> None:
        event = new or old
        assert event is not None  # noqa: S101 - at least one of them exists
        examples = self._row(event).examples
        kind = (old is None, new is None)
        if kind not in ((one is None, other is None) for _, one, other in examples):
            examples.append((event.at - self._start, old, new))


def _key(event: Delivery) -> tuple[str, bytes]:
    return event.target, blake2b(event.data, digest_size=12).digest()


def _loss(event: Event) -> Loss | None:
    match event:
        case Dropped():
            return "dropped", event.route, event.target, event.reason
        case Filtered():
            return "withheld", event.route, event.target, "when"
        case Rejected():
            return "rejected", event.listener, "", event.reason
        case Superseded():
            return "superseded", event.listener, "", "by a later payload"
    return None


# The report


_MOST_FIELDS = 12
_MOST_SENDERS = 5
_COLUMNS = ("old", "new", "same", "changed", "moved", "lost", "added")


class _Content(NamedTuple):
    """The kind of a delivery, and its fields by path."""

    name: str
    fields: dict[str, str]


class Report:
    """A comparison as plain lines: counts by route and target, then fields that differ."""

    def __init__(self, old: Checked, new: Checked) -> None:
        self._tables = (old, new)
        self._indexes = (TableIndex(old), TableIndex(new))
        self._wires = tuple(Wire(checked.envelopes) for checked in (old, new) if checked.envelopes)

    def lines(self, comparison: Against) -> Iterator[str]:
        """Yield the whole report; a short one if both tables deliver the same."""
        old, new = (checked.path for checked in self._tables)
        yield f"{comparison.datagrams} datagrams of {comparison.span / 1e9:.1f} s, through {old} and {new}"
        if not comparison.differs:
            yield f"both deliver the same, {sum(row.old for row in comparison.rows.values())} datagrams and messages"
            yield from _same_losses(comparison)
            yield from _strangers(comparison)
            return
        yield from _counts(comparison)
        yield from _losses(comparison)
        for (route, target), row in sorted(comparison.rows.items()):
            for at, before, after in row.examples:
                if _is_reported(row, before, after):
                    yield ""
                    yield f"{route} to {target}, {at / 1e9:.3f} s after the beginning:"
                    yield from self._example(before, after)
        yield from _strangers(comparison)

    def _example(self, before: Delivery | None, after: Delivery | None) -> Iterator[str]:
        if before is None or after is None:
            which, content = ("old", self._content(0, before)) if before else ("new", self._content(1, after))
            listed = " ".join([f"{name}={value}" for name, value in content.fields.items()][:_MOST_FIELDS])
            yield f"  with the {which} table only: {content.name} {listed}"
            return
        old, new = self._content(0, before), self._content(1, after)
        if old.name != new.name:
            yield f"  {old.name} became {new.name}"
        differing = [name for name in {**old.fields, **new.fields} if old.fields.get(name) != new.fields.get(name)]
        for name in differing[:_MOST_FIELDS]:
            yield f"  {name}: {old.fields.get(name, 'nothing')} became {new.fields.get(name, 'nothing')}"
        if len(differing) > _MOST_FIELDS:
            yield f"  and {len(differing) - _MOST_FIELDS} more fields"
        if not differing and old.name == new.name:
            yield "  the same fields, encoded differently"

    def _content(self, side: int, event: Delivery | None) -> _Content:
        assert event is not None  # noqa: S101 - an example has one of the two
        unread = _Content("a message" if isinstance(event, Published) else "a datagram", {"bytes": event.data.hex()})
        if isinstance(event, Sent):
            try:
                wire = self._wires[side]
                decoded = wire.decode(event.data, wire.envelopes.to(event.target))
            except DecodeError:
                return unread
            return _Content(decoded.case.name, dict(leaves(decoded.case.type, decoded.message)))
        kind = self._indexes[side].type(event.route, event.target)
        if kind is None:
            return unread
        try:
            return _Content(kind.name, dict(leaves(kind, cdr.deserialize(kind, event.data))))
        except (MappingError, ValueError):
            return unread._replace(name=kind.name)


def _counts(comparison: Against) -> Iterator[str]:
    rows = {key: row for key, row in sorted(comparison.rows.items()) if row.differs}
    if not rows:
        return
    width = [max(map(len, column)) for column in zip(("route", "target"), *rows, strict=True)]
    yield ""
    yield f"{'route':{width[0]}}  {'target':{width[1]}}" + "".join(f"{name:>9}" for name in _COLUMNS)
    for (route, target), row in rows.items():
        counts = [getattr(row, name) for name in _COLUMNS]
        yield f"{route:{width[0]}}  {target:{width[1]}}" + "".join(f"{count:9}" for count in counts)


def _losses(comparison: Against) -> Iterator[str]:
    old, new = comparison.losses
    changed = sorted(loss for loss in {*old, *new} if old[loss] != new[loss])
    if changed:
        yield ""
    for loss in changed:
        done, place, target, reason = loss
        to = f" to {target}" if target else ""
        yield f"{done} ({reason}): {place}{to}: {old[loss]} with the old table, {new[loss]} with the new one"


def _same_losses(comparison: Against) -> Iterator[str]:
    """Yield what both tables lost: everything if the recording is from another network."""
    counts: Counter[str] = Counter()
    for (done, _, _, reason), count in comparison.losses[0].items():
        counts[f"{done} ({reason})"] += count
    for what, count in sorted(counts.items()):
        yield f"{what}: {count} with both"


def _strangers(comparison: Against) -> Iterator[str]:
    """Yield why almost nothing was delivered, if the tables are for a different network from the recording."""
    if not comparison.is_among_strangers:
        return
    named = sorted({f"{name or 'a stranger'} at {peer[0]}" for name, _, peer in comparison.senders})
    more = f" and {len(named) - _MOST_SENDERS} more" if len(named) > _MOST_SENDERS else ""
    yield ""
    yield f"neither table has an endpoint for any sender of the recording: {', '.join(named[:_MOST_SENDERS])}{more};"
    yield "compare tables with the addresses of the recording"


def _is_reported(row: Row, before: Delivery | None, after: Delivery | None) -> bool:
    """Return whether an example is reported: deliveries that only changed their time are not."""
    if before is None:
        return row.added > 0
    return after is not None or row.lost > 0
