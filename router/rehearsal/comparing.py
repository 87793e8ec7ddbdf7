"""Compares what happened in a step with what a test expects, and names the places of differences in test and table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from router.compiler import Checked
from router.compiler.compiled_table import CompiledTable
from router.compiler.expressions.tree import ENVELOPE
from router.datagrams import Wire
from router.errors import DecodeError, Located, SourceSpan
from router.rehearsal import cdr
from router.rehearsal.describing import EventDescriber, Related, in_brackets, when
from router.rehearsal.fields import Difference
from router.rehearsal.rehearsal import (
    Disobeyed,
    Dropped,
    Event,
    Filtered,
    Obeyed,
    Published,
    Received,
    Rejected,
    Sent,
)
from router.rehearsal.steps import Counts, Deliveries, Delivery, Expected, Step
from router.types.framing import restored, trimmed


@dataclass(frozen=True, slots=True)
class Failure:
    """One difference from what a test expects; `is_of_field` if only the content of a message differs."""

    span: SourceSpan
    message: str
    table: Related | None = None
    is_of_field: bool = False


@dataclass(frozen=True, slots=True)
class Outcome:
    """What happened in a step: events before its time (`early`) and in it, and the states after it.

    `given` has times and bytes of messages.
    """

    step: Step
    early: Sequence[Event]
    events: Sequence[Event]
    given: Sequence[tuple[int, bytes]]
    states: Mapping[str, str]

    def given_at(self, at: int) -> int:
        """Return the arrival (ns) of the last message that a delivery at this time can contain."""
        return max((time for time, _ in self.given if time <= at), default=at)


class Comparison:
    """Compares the steps of the tests of one table; `describer` describes events."""

    def __init__(self, checked: Checked, program: CompiledTable) -> None:
        self._wire = Wire(program.envelopes)
        self.describer = EventDescriber(checked, program)
        self._index = self.describer.index
        self._table = program.table

    def failures(self, outcome: Outcome) -> Iterator[Failure]:
        """Yield the failures, in the order in which a person would look for them."""
        expected, events = outcome.step.expected, outcome.events
        yield from self._early(outcome)
        if expected.anything:
            return
        rejected = [event for event in events if isinstance(event, Rejected)]
        unexpected = list(_rejected(expected, rejected))
        yield from unexpected
        yield from _routes(expected, events)
        explained = bool(rejected and unexpected)
        for kind, deliveries in ((Sent, expected.sent), (Published, expected.published)):
            actual: dict[str, list[Sent | Published]] = {}
            for event in events:
                if isinstance(event, kind):
                    actual.setdefault(event.target, []).append(event)
            yield from self._delivered(deliveries, actual, outcome, explained=explained)
        yield from self._dropped(outcome)
        yield from _filtered(expected, events)
        yield from self._answers(expected, events)
        yield from self._states(outcome)

    def _states(self, outcome: Outcome) -> Iterator[Failure]:
        for name, wanted in outcome.step.expected.states.items():
            if (actual := outcome.states[name]) != wanted.value:
                related = Related(self._table.states[name].span, "the state")
                yield Failure(wanted.span, f"state.{name} is {actual}, not {wanted.value}", related)

    def _early(self, outcome: Outcome) -> Iterator[Failure]:
        """Yield a failure for each place with an event between the previous step and this one."""
        related: dict[Related | None, list[Event]] = {}
        for event in outcome.early:
            if isinstance(event, (Sent, Published, Dropped, Obeyed, Disobeyed)):
                related.setdefault(self.describer.related(event), []).append(event)
        for place, events in related.items():
            message = f"before this step, {self.describer.summarize(events)}; no step expects it"
            yield Failure(outcome.step.expected.span, message, place)

    # what is delivered

    def _delivered(
        self, expected: Deliveries, actual: Mapping[str, list[Sent | Published]], outcome: Outcome, *, explained: bool
    ) -> Iterator[Failure]:
        """Yield the failures. `explained`: an already reported rejection explains why targets got nothing."""
        for target in dict.fromkeys((*expected, *actual)):
            deliveries, events = expected.get(target, ()), actual.get(target, [])
            if deliveries and not events:
                if not explained:
                    yield self._missing(target, deliveries[0].span, outcome)
            elif not deliveries:
                message = f"{self.describer.summarize(events)}; it is not expected"
                yield Failure(outcome.step.expected.span, message, self.describer.related(events[0]))
            elif len(deliveries) != len(events):
                message = f"{len(events)} for {target}, not {len(deliveries)}: {self.describer.summarize(events)}"
                yield Failure(deliveries[0].span, message, self.describer.related(events[-1]))
            else:
                for delivery, event in zip(deliveries, events, strict=True):
                    yield from self._differences(delivery, event, outcome)

    def _missing(self, target: str, span: SourceSpan, outcome: Outcome) -> Failure:
        """Return a failure that says what happened to the message instead, if there is an event for it."""
        for event in outcome.events:
            if isinstance(event, Dropped) and event.target == target:
                why = f"it was dropped as {event.reason}{in_brackets(event.detail)}"
                return Failure(span, f"nothing for {target}: {why}", self.describer.related(event))
            if isinstance(event, Filtered) and event.target == target:
                condition = self._index.condition(event.route, target)
                return Failure(span, f"nothing for {target}: it was withheld", condition)
        return Failure(span, f"nothing for {target}", self._of_name(target, outcome))

    def _differences(self, expected: Delivery, event: Sent | Published, outcome: Outcome) -> Iterator[Failure]:
        if isinstance(event, Published):
            if expected.fields is not None:
                published = cdr.deserialize(expected.fields.type, event.data)
                now = outcome.given_at(event.at)
                for difference in expected.fields.differences((), expected.fields.type, published, now):
                    yield self._different_field(difference, event)
        elif expected.is_unchanged:
            trims = self._table.endpoints[event.target].trim_trailing_zeros
            wholes = [restored(data) for _, data in outcome.given]
            if event.data not in [trimmed(whole) if trims else whole for whole in wholes]:
                message = f"{self.describer.describe(event)}, not what was given"
                yield Failure(expected.span, message, self.describer.related(event))
        elif expected.data is not None:
            if event.data != expected.data:
                message = f"{event.target} gets the bytes {event.data.hex(' ')}, not {expected.data.hex(' ')}"
                yield Failure(expected.span, message, self.describer.related(event))
        elif expected.case is not None:
            yield from self._different_payload(expected, expected.case.name, event, outcome)

    def _different_payload(self, expected: Delivery, case: str, event: Sent, outcome: Outcome) -> Iterator[Failure]:
        around = self._wire.envelopes.to(event.target)
        try:
            decoded = self._wire.decode(event.data, around)
        except DecodeError as error:
            yield Failure(
                expected.span,
                f"{event.target} gets bytes that are not an envelope: {error}",
                self.describer.related(event),
            )
            return
        if decoded.case.name != case:
            yield Failure(expected.span, f"{self.describer.describe(event)}, not {case}", self.describer.related(event))
            return
        now = outcome.given_at(event.at)
        if expected.fields is not None:
            for difference in expected.fields.differences((), decoded.case.type, decoded.message, now):
                yield self._different_field(difference, event)
        if expected.beside is not None:
            whole = around.message_class.FromString(restored(event.data))
            for difference in expected.beside.differences((ENVELOPE,), around.beside, whole, now):
                yield self._different_field(difference, event)

    def _different_field(self, difference: Difference, event: Sent | Published) -> Failure:
        is_mapped = not (isinstance(event, Sent) and event.by_deadman)
        field = self._index.field(event.route, event.target, difference.path) if is_mapped else None
        message = f"{when(event)}{event.target}: {difference}"
        return Failure(difference.span, message, field or self.describer.related(event), is_of_field=True)

    # what is not delivered

    def _dropped(self, outcome: Outcome) -> Iterator[Failure]:
        expected = outcome.step.expected
        nothing: Located[Counts] = Located({}, expected.span)
        actual: dict[str, list[Dropped]] = {}
        for event in outcome.events:
            if isinstance(event, Dropped):
                actual.setdefault(event.target, []).append(event)
        served = {event.target for event in outcome.events if isinstance(event, (Sent, Published))}
        missing = {target for target in (*expected.sent, *expected.published) if target not in served}
        for target in dict.fromkeys((*expected.dropped, *actual)):
            wanted = expected.dropped.get(target, nothing)
            dropped = actual.get(target, [])
            counts = Counter(event.reason for event in dropped)
            is_reported = target not in expected.dropped and target in missing  # as the reason why it is missing
            if counts != Counter(wanted.value) and not is_reported:
                detail = next((f" ({event.detail})" for event in dropped if event.detail), "")
                message = f"dropped for {target}: {_listed(counts)}, not {_listed(wanted.value)}{detail}"
                related = self.describer.related(dropped[0]) if dropped else self._of_name(target, outcome)
                yield Failure(wanted.span, message, related)

    def _answers(self, expected: Expected, events: Sequence[Event]) -> Iterator[Failure]:
        """Yield failures about endpoints that obey the brake of a deadman, or do not."""
        kinds = (Obeyed, "obeyed", expected.obeyed), (Disobeyed, "disobeyed", expected.disobeyed)
        for kind, word, expects in kinds:
            wanted: Located[Counts] = expects or Located({}, expected.span)
            actual = [event for event in events if isinstance(event, kind)]
            counts = Counter(event.target for event in actual)
            if counts != Counter(wanted.value):
                message = f"{word}: {_listed(counts)}, not {_listed(wanted.value)}"
                yield Failure(wanted.span, message, self.describer.related(actual[0]) if actual else None)

    # places and words

    def _of_name(self, target: str, outcome: Outcome) -> Related | None:
        """Return where in the table the delivery to a target is missing."""
        return self._index.of_name(target, (event.route for event in outcome.events if isinstance(event, Received)))


def _rejected(expected: Expected, events: Sequence[Rejected]) -> Iterator[Failure]:
    actual = Counter(event.reason for event in events)
    wanted = expected.rejected or Located({}, expected.span)
    if actual != Counter(wanted.value):
        detail = in_brackets(events[0].detail) if events else ""
        message = f"rejected: {_listed(actual)}, not {_listed(wanted.value)}{detail}"
        yield Failure(wanted.span, message)


def _routes(expected: Expected, events: Iterable[Event]) -> Iterator[Failure]:
    taken = {event.route for event in events if isinstance(event, Received)}
    if expected.route is not None and taken != {expected.route.value}:
        actual = f"the route is {', '.join(sorted(taken))}" if taken else "no route takes it"
        yield Failure(expected.route.span, f"{actual}, not {expected.route.value}")


def _filtered(expected: Expected, events: Iterable[Event]) -> Iterator[Failure]:
    actual = Counter(event.target for event in events if isinstance(event, Filtered))
    if expected.filtered is not None and actual != Counter(expected.filtered.value):
        message = f"withheld from: {_listed(actual)}, not {_listed(expected.filtered.value)}"
        yield Failure(expected.filtered.span, message)


def _listed(counts: Counts) -> str:
    """Return counts as text: `stale, 3 rate_limited`."""
    listed = (f"{count} {name}" if count > 1 else name for name, count in sorted(counts.items()))
    return ", ".join(listed) or "nothing"
