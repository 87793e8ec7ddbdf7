"""Reads the events of native threads: rejected datagrams, lost messages, and changes of deadmen."""

from __future__ import annotations

import ctypes
import os
import select
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Union, cast

from router.carrier.threads import NativeThread
from router.compiler.metrics import Answer, Evidence, Mismatch, Report
from router.compiler.refusals import DROP_REASON_NAMES, REJECTIONS, why_refused
from router.declared import (
    NO_NAME,
    AnswerEvent,
    DatagramEvent,
    DeadmanEvent,
    EventHead,
    EventKind,
    LearnedEvent,
    LinkEvent,
    LostEvent,
    Reason,
    ReplyEvent,
    ReturnedEvent,
    StateContent,
    StateEvent,
)
from router.hosts import with_port
from router.image.names import Names
from router.net.addresses import host_text, origin_text
from router.threads import Thread, join_or_abandon

_PULSE_MS = 5000
_MISMATCHES = (Reason.UNKNOWN_CASE, Reason.UNHANDLED, Reason.SOURCE_MISMATCH)


@dataclass(frozen=True, slots=True)
class DeadmanChange:
    """The deadman of a route has tripped or was released."""

    route: str
    is_tripped: bool


@dataclass(frozen=True, slots=True)
class Returned:
    """An endpoint is heard again after a silence (s)."""

    endpoint: str
    silence: float


@dataclass(frozen=True, slots=True)
class Learned:
    """The address of an endpoint was learned. `before` is the earlier one, "" if there was none.

    `after` is "" if a reload has excluded the earlier one.
    """

    endpoint: str
    before: str
    after: str


@dataclass(frozen=True, slots=True)
class StateChange:
    """The value of a state has changed. `source` has set it; None if it has expired, or by a reload."""

    state: str
    before: int | str
    after: int | str
    source: str | None


@dataclass(frozen=True, slots=True)
class LinkChange:
    """The link to an endpoint was opened (`error` is 0), was closed, or cannot be opened (errno)."""

    endpoint: str
    error: int


@dataclass(frozen=True, slots=True)
class Reply:
    """A reply for a service: its response as CDR bytes, after the value of `match`."""

    service: str
    message: bytes


@dataclass(frozen=True, slots=True)
class CountedReport:
    """A loss or a rejection, and the counter of its kind."""

    counter: int
    report: Report


DeadmanEvents = Union[DeadmanChange, Answer, Evidence]


class EventReader:
    """Converts records of `native/events.h` to reports.

    `why_rejected(listener, reason, data, length)` describes why a datagram was rejected, and `superseded(listener,
    data)` the payloads of one that has several. `place(route, topic, target, generation, place)` returns the place of
    the table that refused a message of `topic` (None: a datagram), or "".
    """

    def __init__(
        self,
        names: Names,
        why_rejected: Callable[[str, int, bytes, int], str],
        superseded: Callable[[str, bytes], str],
        place: Callable[[str, str | None, str, int, int], str],
    ) -> None:
        self._name = names.name
        self._why_rejected = why_rejected
        self._superseded = superseded
        self._place = place

    def read(
        self, kind: int, record: memoryview
    ) -> DeadmanEvents | StateChange | Learned | Returned | LinkChange | Reply | CountedReport:
        if kind in {EventKind.REJECTED, EventKind.SUPERSEDED}:
            return self._of_datagram(record)
        if kind == EventKind.LOST:
            return self._lost(record)
        if kind in {EventKind.OBEYED, EventKind.DISOBEYED, EventKind.EVIDENCE}:
            return self._answer(kind, record)
        if kind == EventKind.RETURNED:
            returned = ReturnedEvent.from_buffer(record)
            return Returned(self._name(returned.endpoint), returned.silence / 1e9)
        if kind == EventKind.LEARNED:
            learned = LearnedEvent.from_buffer(record)
            earlier, present = (origin_text(at) if at else "" for at in (learned.before, learned.after))
            return Learned(self._name(learned.endpoint), earlier, present)
        if kind == EventKind.REPLY:
            reply, begin = ReplyEvent.from_buffer(record), ctypes.sizeof(ReplyEvent)
            return Reply(self._name(reply.target), bytes(record[begin : begin + reply.length]))
        if kind == EventKind.STATE:
            changed = StateEvent.from_buffer(record)
            source = self._name(changed.source) if changed.source != NO_NAME else None
            was, became = (content_of(each, changed.is_text) for each in (changed.before, changed.after))
            return StateChange(self._name(changed.state), was, became, source)
        if kind == EventKind.LINK:
            link = LinkEvent.from_buffer(record)
            return LinkChange(self._name(link.endpoint), link.error)
        event = DeadmanEvent.from_buffer(record)
        route = self._name(event.deadman)
        if kind != EventKind.DEADMAN_ERROR:
            return DeadmanChange(route, kind == EventKind.TRIPPED)
        text = _text(record[ctypes.sizeof(event) :])
        error = _error(event.error) or OSError(f"it cannot be published: {text}")
        return CountedReport(
            event.counter, Report("deadman", route, self._name(event.destination), "send_error", error)
        )

    def _answer(self, kind: int, record: memoryview) -> Answer | Evidence:
        event, begin = AnswerEvent.from_buffer(record), ctypes.sizeof(AnswerEvent)
        place = self._name(event.deadman), self._name(event.destination)
        if kind == EventKind.EVIDENCE:
            return Evidence(*place, bytes(record[begin : begin + event.after]))
        return Answer(*place, kind == EventKind.OBEYED, event.after)

    def _of_datagram(self, record: memoryview) -> CountedReport:
        event, begin = DatagramEvent.from_buffer(record), ctypes.sizeof(DatagramEvent)
        listener, data = self._name(event.listener), bytes(record[begin : begin + event.length])
        host = host_text(event.address)
        place = with_port(host, event.port) if event.port else host
        sender = f"from {place}" if event.address else "from the serial line"
        if event.kind == EventKind.SUPERSEDED:
            detail = f"{sender}: {self._superseded(listener, data)}"
            return CountedReport(event.counter, Report("supersede", listener, "", "superseded", None, detail))
        what = self._why_rejected(listener, event.reason, data, event.length)
        detail = sender + (f": {what}" if what else "")
        mismatch = Mismatch(listener, host, what) if event.reason in _MISMATCHES and event.length else None
        report = Report("reject", listener, "", REJECTIONS[event.reason], None, detail, mismatch=mismatch)
        return CountedReport(event.counter, report)

    def _lost(self, record: memoryview) -> CountedReport:
        event = LostEvent.from_buffer(record)
        route, target = self._name(event.route), self._name(event.target)
        text = bytes(record[ctypes.sizeof(event) :]).partition(b"\0")[0]
        detail = why_refused(event.refusal, text) if event.refusal.kind else text.decode(errors="replace")
        if event.generation:  # the table's program refused the message
            topic = self._name(event.topic) if event.topic != NO_NAME else None
            place = self._place(route, topic, target, event.generation, event.place)
            detail = ": ".join(filter(None, (place, detail)))
        return CountedReport(
            event.counter, Report("drop", route, target, DROP_REASON_NAMES[event.reason], _error(event.error), detail)
        )


class EventThread:
    """Reads the events of native threads, and calls `pulse` every few seconds to signal that Python is alive.

    Of many losses of a kind, only a few are written as events, but `report` gets their full number from the counter
    that the event names. `returned` gets an endpoint that is heard again, and how long it was silent (s), `learned` one
    whose address was learned, with the address before and now, `link_changed` an endpoint and why the link to it is
    closed (errno; 0: it is open), `state_changed` a state that has changed, `replied` a reply for a service,
    `of_deadmen` everything else.
    """

    def __init__(
        self,
        threads: Sequence[NativeThread],
        reader: EventReader,
        report: Callable[[Report], None],
        of_deadmen: Callable[[DeadmanEvents], None],
        returned: Callable[[str, float], None],
        learned: Callable[[str, str, str], None],
        link_changed: Callable[[str, int], None],
        state_changed: Callable[[StateChange], None],
        replied: Callable[[Reply], None],
        pulse: Callable[[], None],
    ) -> None:
        self._threads = threads
        self._reader = reader
        self._report = report
        self._of_deadmen = of_deadmen
        self._returned = returned
        self._learned = learned
        self._link_changed = link_changed
        self._state_changed = state_changed
        self._replied = replied
        self._pulse = pulse
        self._stopping = False
        self._last: list[dict[int, tuple[int, Report]]] = [{} for _ in threads]
        """By thread and counter: the reported number, and the last report."""
        self._wakes = [thread.events.watch() for thread in threads]
        self._thread = Thread(self._run, "carrier events")

    def start(self) -> None:
        """Start the thread, which also reads earlier events, for example of a head start."""
        self._thread.start()

    def close(self) -> None:
        """Read the remaining events, and end the thread."""
        self._stopping = True
        os.eventfd_write(self._wakes[0], 1)
        join_or_abandon(self._thread)

    def _run(self) -> None:
        poll = select.poll()
        for wake in self._wakes:
            poll.register(wake, select.POLLIN)
        while not self._stopping:
            self._pulse()
            self._read()
            for wake, _ in poll.poll(_PULSE_MS):
                os.eventfd_read(wake)
        self._read()

    def _read(self) -> None:
        for thread, last in zip(self._threads, self._last, strict=True):
            counters = cast("Sequence[int]", thread.counts)
            while records := thread.events.take():
                position = 0
                while position < len(records):
                    head = EventHead.from_buffer(records, position)
                    self._dispatch(head.kind, records[position : position + head.size], counters, last)
                    position += head.size
            for counter, (_, report) in list(last.items()):  # losses without an event
                self._count(counter, report, counters, last)

    def _dispatch(
        self, kind: int, record: memoryview, counters: Sequence[int], last: dict[int, tuple[int, Report]]
    ) -> None:
        match self._reader.read(kind, record):
            case Returned(endpoint, silence):
                self._returned(endpoint, silence)
            case Learned(endpoint, before, after):
                self._learned(endpoint, before, after)
            case StateChange() as change:
                self._state_changed(change)
            case LinkChange(endpoint, error):
                self._link_changed(endpoint, error)
            case Reply() as reply:
                self._replied(reply)
            case CountedReport(counter, report):
                self._count(counter, report, counters, last)
            case of_deadman:
                self._of_deadmen(of_deadman)

    def _count(
        self, counter: int, report: Report, counters: Sequence[int], last: dict[int, tuple[int, Report]]
    ) -> None:
        """Report the losses that this counter has counted since the last report."""
        total = counters[counter]
        reported = last[counter][0] if counter in last else 0
        if total < reported:  # a reload has reassigned the counter
            reported = 0
        last[counter] = total, report
        if total > reported:
            self._report(replace(report, times=total - reported))


def content_of(content: StateContent, is_text: bool) -> int | str:
    """Return the value of a state."""
    return bytes(content.text[: content.number]).decode(errors="replace") if is_text else content.number


def _error(number: int) -> OSError | None:
    return OSError(number, os.strerror(number)) if number else None


def _text(record: memoryview) -> str:
    return bytes(record).partition(b"\0")[0].decode(errors="replace")
