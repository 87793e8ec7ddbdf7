"""A recording through two tables on one clock: which deliveries are the same, and which are not.

Counts by route and target, and keeps a few examples of each. Knows rehearsals, and no words for a person.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b

from router.compiler.program import Program
from router.recording.mirror import Classifier, Peer
from router.recording.reader import Recorded
from router.rehearsal.events import Dropped, Event, Filtered, Published, Rejected, Sent
from router.rehearsal.rehearsal import Rehearsal

Delivery = Sent | Published
Loss = tuple[str, str, str, str]


@dataclass(slots=True)
class Row:
    """What one target got of one route. `moved` came from both tables with the same bytes at different times.

    `examples`, one of a kind, have the nanoseconds since the beginning, and the delivery of either table, if there is.
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
    """`take` the datagrams in order. `rows` are by route and target, `losses` count what each table did not deliver.

    A loss is what was done (dropped, withheld, rejected), where (a route, or a listener), for which target, and why.
    """

    def __init__(self, old: Program, new: Program) -> None:
        self.rows: dict[tuple[str, str], Row] = {}
        self.losses: tuple[Counter[Loss], Counter[Loss]] = (Counter(), Counter())
        self.datagrams = 0
        self.span = 0
        """ns from the first datagram to the last."""
        self.senders: set[tuple[str, str, Peer]] = set()
        """What the recording calls them, by which listener they came, and where they are."""
        self._programs = (old, new)
        self._runs: tuple[Rehearsal, ...] = ()
        self._first = self._start = 0
        self._waiting: tuple[Counter[tuple[str, bytes]], ...] = (Counter(), Counter())
        """Deliveries that the other table has not made so far, by target and what was delivered."""

    def take(self, found: Recorded) -> None:
        if not self._runs:
            self._first, self._start = found.steady, found.at
            self._runs = tuple(Rehearsal(program, found.at) for program in self._programs)
        self.datagrams += 1
        self.span = found.steady - self._first
        self.senders.add((found.endpoint, found.listener, found.peer))
        for run, program in zip(self._runs, self._programs, strict=True):
            run.advance(self._start + self.span)
            if found.listener in program.table.listeners:
                run.datagram(found.listener, found.peer, found.data)
            else:
                run.events.append(Rejected(run.now, found.listener, "no such listener"))
        old, new = (self._deliveries(side) for side in (0, 1))
        for target in dict.fromkeys((*old, *new)):
            self._compare(old.get(target, []), new.get(target, []))

    @property
    def differs(self) -> bool:
        return self.losses[0] != self.losses[1] or any(row.differs for row in self.rows.values())

    @property
    def is_among_strangers(self) -> bool:
        """Whether neither table knows anybody who sent."""
        tables = [Classifier(program.envelope, program.table) for program in self._programs]
        places = {(listener, peer) for _, listener, peer in self.senders}
        return bool(places) and not any(table.sender(*place) for table in tables for place in places)

    def _deliveries(self, side: int) -> dict[str, list[Delivery]]:
        """Since the last time, by target; what was lost is counted."""
        found: dict[str, list[Delivery]] = {}
        for event in self._runs[side].events:
            if isinstance(event, (Sent, Published)):
                found.setdefault(_target(event), []).append(event)
            elif (loss := _loss(event)) is not None:
                self.losses[side][loss] += 1
        self._runs[side].events.clear()
        return found

    def _compare(self, old: Sequence[Delivery], new: Sequence[Delivery]) -> None:
        """What one target got from one datagram and the time before it."""
        for each in old:
            self._row(each).old += 1
        for each in new:
            self._row(each).new += 1
        only_old = self._without_same(old, Counter(map(_content, new)), count=True)
        only_new = self._without_same(new, Counter(map(_content, old)), count=False)
        only_old = list(self._not_waited_for(only_old, 1))
        only_new = list(self._not_waited_for(only_new, 0))
        both = min(len(only_old), len(only_new))
        for before, after in zip(only_old[:both], only_new[:both], strict=True):
            self._row(after).changed += 1
            self._example(before, after)
        for each in only_old[both:]:
            self._waiting[0][_key(each)] += 1
            self._example(each, None)
        for each in only_new[both:]:
            self._waiting[1][_key(each)] += 1
            self._example(None, each)

    def _without_same(self, found: Sequence[Delivery], others: Counter[bytes], *, count: bool) -> list[Delivery]:
        left = []
        for each in found:
            content = _content(each)
            if others[content]:
                others[content] -= 1
                self._row(each).same += count
            else:
                left.append(each)
        return left

    def _not_waited_for(self, found: Sequence[Delivery], other: int) -> Iterator[Delivery]:
        """Without those that the other table made earlier."""
        waiting = self._waiting[other]
        for each in found:
            if waiting[key := _key(each)]:
                waiting[key] -= 1
                self._row(each).moved += 1
            else:
                yield each

    def _row(self, event: Delivery) -> Row:
        return self.rows.setdefault((event.route, _target(event)), Row())

    def _example(self, old: Delivery | None, new: Delivery | None) -> None:
        event = new or old
        assert event is not None  # noqa: S101 - there is one of them
        examples = self._row(event).examples
        kind = (old is None, new is None)
        if kind not in ((one is None, other is None) for _, one, other in examples):
            examples.append((event.at - self._start, old, new))


def _target(event: Delivery) -> str:
    return event.endpoint if isinstance(event, Sent) else event.topic


def _content(event: Delivery) -> bytes:
    return event.data if isinstance(event, Sent) else event.cdr


def _key(event: Delivery) -> tuple[str, bytes]:
    return _target(event), blake2b(_content(event), digest_size=12).digest()


def _loss(event: Event) -> Loss | None:
    match event:
        case Dropped():
            return "dropped", event.route, event.target, event.reason
        case Filtered():
            return "withheld", event.route, event.target, "when"
        case Rejected():
            return "rejected", event.listener, "", event.reason
    return None
