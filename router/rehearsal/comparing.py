"""Compares what happened in a step with what a test expects: each difference with its place in test and table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from router.engine.wire import Wire
from router.errors import DecodeError, Located, SourceSpan
from router.rehearsal.events import Dropped, Event, Filtered, Published, Received, Rejected, Sent
from router.rehearsal.matching import Difference
from router.rehearsal.model import Counted, Expected, Item, Message, Payload, Step, Unchanged
from router.rehearsal.places import Place, Places
from router.rehearsal.words import Happened, Words
from router.table.model import RouteTable
from tests.oracles import reference_cdr

_SHOWN = 3
"""So many of what came are told where their number is not what was expected."""


@dataclass(frozen=True, slots=True)
class Failure:
    """One thing that a table does not do as a test expects. `table` is the place there that has to do with it."""

    span: SourceSpan
    message: str
    table: Place | None = None


class Comparison:
    def __init__(self, wire: Wire, places: Places, table: RouteTable) -> None:
        self._wire = wire
        self._places = places
        self._words = Words(wire, places)
        self._table = table

    def failures(self, step: Step, happened: Happened) -> Iterator[Failure]:
        """In the order in which a person would look for them."""
        expected = step.expected
        yield from self._early(expected, happened)
        if expected.anything:
            return
        rejected = [event for event in happened.events if isinstance(event, Rejected)]
        unexpected = list(self._rejected(expected, rejected))
        yield from unexpected
        yield from self._routes(expected, happened.events)
        is_told = bool(rejected and unexpected)
        sent = [event for event in happened.events if isinstance(event, Sent)]
        yield from self._delivered(expected.sent, _by_target(sent), happened, is_told)
        published = [event for event in happened.events if isinstance(event, Published)]
        yield from self._delivered(expected.published, _by_target(published), happened, is_told)
        yield from self._dropped(expected, happened)
        yield from self._filtered(expected, happened.events)

    def _early(self, expected: Expected, happened: Happened) -> Iterator[Failure]:
        """What happened since the step before, at no time that a step has."""
        by_place: dict[Place | None, list[Event]] = {}
        for event in happened.early:
            if isinstance(event, (Sent, Published, Dropped)):
                by_place.setdefault(self._words.place(event), []).append(event)
        for place, events in by_place.items():
            more = f", and so on, {len(events)} in all" if len(events) > 1 else ""
            message = f"before this step, {self._words.told(events[0], happened)}{more}; no step expects it"
            yield Failure(expected.span, message, place)

    # what is delivered

    def _delivered(
        self,
        expected: Mapping[str, tuple[Item, ...]],
        came: Mapping[str, list[Sent | Published]],
        happened: Happened,
        is_told: bool,
    ) -> Iterator[Failure]:
        for target in dict.fromkeys((*expected, *came)):
            items, events = expected.get(target, ()), came.get(target, [])
            if items and not events:
                if not is_told:  # as the rejection that it comes from
                    yield self._missing(target, items, happened)
            elif not items:
                yield from self._unexpected(events, happened)
            elif len(items) != len(events):
                listed = "; ".join(self._words.told(event, happened) for event in events[:_SHOWN])
                more = f"; and {len(events) - _SHOWN} more" if len(events) > _SHOWN else ""
                message = f"{len(events)} for {target}, not {len(items)}: {listed}{more}"
                yield Failure(items[0].span, message, self._words.place(events[-1]))
            else:
                for item, event in zip(items, events, strict=True):
                    yield from self._differences(item, event, happened)

    def _missing(self, target: str, items: Sequence[Item], happened: Happened) -> Failure:
        """With what became of the message instead, where the counters know."""
        for event in happened.events:
            if isinstance(event, Dropped) and event.target == target:
                why = f"it was dropped as {event.reason}" + (f" ({event.detail})" if event.detail else "")
                return Failure(items[0].span, f"nothing for {target}: {why}", self._words.place(event))
            if isinstance(event, Filtered) and event.target == target:
                place = self._places.condition(event.route, target)
                return Failure(items[0].span, f"nothing for {target}: it was withheld", place)
        return Failure(items[0].span, f"nothing for {target}", self._of_name(target, happened))

    def _unexpected(self, events: Sequence[Sent | Published], happened: Happened) -> Iterator[Failure]:
        first, count = events[0], len(events)
        times = f", {count} times" if count > 1 else ""
        message = f"{self._words.told(first, happened)}{times}; it is not expected"
        yield Failure(happened.step.expected.span, message, self._words.place(first))

    def _differences(self, item: Item, event: Sent | Published, happened: Happened) -> Iterator[Failure]:
        content, moments = item.content, happened.moments(event.at)
        match content, event:
            case Unchanged(), Sent():
                trims = self._table.endpoints[event.endpoint].trim_trailing_zeros
                if event.data not in {data.rstrip(b"\0") if trims else data for _, data in happened.given}:
                    yield Failure(
                        item.span, f"{self._words.told(event, happened)}, not what was given", self._words.place(event)
                    )
            case bytes(), Sent():
                if event.data != content:
                    message = f"{event.endpoint} gets the bytes {event.data.hex(' ')}, not {content.hex(' ')}"
                    yield Failure(item.span, message, self._words.place(event))
            case Payload(), Sent():
                yield from self._payload(content, item.span, event, happened)
            case Message(), Published():
                found = reference_cdr.parse(content.type, event.cdr)
                for difference in content.fields.differences((), content.type, found, moments):
                    yield self._failure(difference, event, event.topic, happened)

    def _payload(self, expected: Payload, span: SourceSpan, event: Sent, happened: Happened) -> Iterator[Failure]:
        try:
            decoded = self._wire.decode(event.data)
        except DecodeError as error:
            yield Failure(span, f"{event.endpoint} gets no envelope: {error}", self._words.place(event))
            return
        if decoded.case.name != expected.case.name:
            message = f"{self._words.told(event, happened)}, not {expected.case.name}"
            yield Failure(span, message, self._words.place(event))
        elif expected.fields is not None:
            kind, moments = expected.case.type, happened.moments(event.at)
            for difference in expected.fields.differences((), kind, decoded.message, moments):
                yield self._failure(difference, event, event.endpoint, happened)

    def _failure(self, difference: Difference, event: Sent | Published, target: str, happened: Happened) -> Failure:
        is_mapped = not (isinstance(event, Sent) and event.by_deadman)
        field = self._places.field(event.route, target, difference.path) if is_mapped else None
        when = happened.time(event)
        return Failure(difference.span, f"{when}{target}: {difference}", field or self._words.place(event))

    # what is not delivered

    def _rejected(self, expected: Expected, events: Sequence[Rejected]) -> Iterator[Failure]:
        came = Counter(event.reason for event in events)
        wanted = expected.rejected or Located({}, expected.span)
        if came != Counter(wanted.value):
            detail = events[0].detail if events else ""
            message = f"rejected: {_counts(came)}, not {_counts(wanted.value)}" + (f" ({detail})" if detail else "")
            yield Failure(wanted.span, message)

    def _routes(self, expected: Expected, events: Iterable[Event]) -> Iterator[Failure]:
        taken = {event.route for event in events if isinstance(event, Received)}
        if expected.route is not None and taken != {expected.route.value}:
            found = f"the route is {', '.join(sorted(taken))}" if taken else "no route takes it"
            yield Failure(expected.route.span, f"{found}, not {expected.route.value}")

    def _dropped(self, expected: Expected, happened: Happened) -> Iterator[Failure]:
        nothing: Located[Counted] = Located({}, expected.span)
        came: dict[str, list[Dropped]] = {}
        for event in happened.events:
            if isinstance(event, Dropped):
                came.setdefault(event.target, []).append(event)
        got_something = {_target(event) for event in happened.events if isinstance(event, (Sent, Published))}
        told = {target for target in (*expected.sent, *expected.published) if target not in got_something}
        for target in dict.fromkeys((*expected.dropped, *came)):
            wanted = expected.dropped.get(target, nothing)
            counts = Counter(event.reason for event in came.get(target, ()))
            is_told = target not in expected.dropped and target in told  # as the reason why it is missing
            if counts != Counter(wanted.value) and not is_told:
                details = {event.detail: None for event in came.get(target, ()) if event.detail}
                detail = f" ({next(iter(details))})" if details else ""
                message = f"dropped for {target}: {_counts(counts)}, not {_counts(wanted.value)}{detail}"
                place = self._words.place(came[target][0]) if target in came else self._of_name(target, happened)
                yield Failure(wanted.span, message, place)

    def _of_name(self, target: str, happened: Happened) -> Place | None:
        """Where the table should have delivered what was given to a target that heard nothing of it."""
        return self._places.of_name(target, (each.route for each in happened.events if isinstance(each, Received)))

    def _filtered(self, expected: Expected, events: Iterable[Event]) -> Iterator[Failure]:
        came = Counter(event.target for event in events if isinstance(event, Filtered))
        if expected.filtered is not None and came != Counter(expected.filtered.value):
            message = f"withheld from: {_counts(came)}, not {_counts(expected.filtered.value)}"
            yield Failure(expected.filtered.span, message)


def _by_target(events: Iterable[Sent | Published]) -> Mapping[str, list[Sent | Published]]:
    found: dict[str, list[Sent | Published]] = {}
    for event in events:
        found.setdefault(_target(event), []).append(event)
    return found


def _target(event: Sent | Published) -> str:
    return event.endpoint if isinstance(event, Sent) else event.topic


def _counts(counts: Counted) -> str:
    """`stale, 3 rate_limited`."""
    listed = (f"{count} {name}" if count > 1 else name for name, count in sorted(counts.items()))
    return ", ".join(listed) or "nothing"
