"""What happened in a step of a table test, in words and with its place in the table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from router.engine.wire import Wire
from router.errors import DecodeError
from router.rehearsal.events import Dropped, Event, Filtered, Published, Sent
from router.rehearsal.matching import Moments
from router.rehearsal.model import Step
from router.rehearsal.places import Place, Places
from router.rehearsal.shown import offset, shown
from tests.oracles import reference_cdr


@dataclass(frozen=True, slots=True)
class Happened:
    """What a step came to: `early` before its time, `events` in it; `given` is when what came in."""

    step: Step
    start: int
    early: Sequence[Event]
    events: Sequence[Event]
    given: Sequence[tuple[int, bytes]]

    def moments(self, at: int) -> Moments:
        """`now` is when the message came in that was the last one at `at`."""
        times = [time for time, _ in self.given if time <= at]
        return Moments(self.start, times[-1] if times else at)

    def time(self, event: Event) -> str:
        """`at 500 ms `, nothing at the beginning of the test."""
        return f"at {offset(event.at - self.start)} " if event.at != self.start else ""


class Words:
    """Says what an event was."""

    def __init__(self, wire: Wire, places: Places) -> None:
        self._wire = wire
        self._places = places

    def told(self, event: Event, happened: Happened) -> str:
        when = happened.time(event)
        match event:
            case Sent():
                by = f" by the deadman of {event.route}" if event.by_deadman else ""
                return f"{when}{self._datagram(event.data)} is sent to {event.endpoint}{by}"
            case Published():
                kind = self._places.type(event.route, event.topic)
                inside = shown(kind, reference_cdr.parse(kind, event.cdr)) if kind else "a message"
                return f"{when}{inside} is published on {event.topic}"
            case Dropped():
                return f"{when}{event.target} misses one as {event.reason}"
        return when

    def _datagram(self, data: bytes) -> str:
        try:
            decoded = self._wire.decode(data)
        except DecodeError:
            return data.hex(" ")
        return f"{decoded.case.name} {shown(decoded.case.type, decoded.message)}"

    def place(self, event: Event) -> Place | None:
        match event:
            case Sent(by_deadman=True):
                return self._places.deadman(event.route)
            case Sent():
                return self._places.target(event.route, event.endpoint)
            case Published():
                return self._places.target(event.route, event.topic)
            case Dropped() | Filtered():
                return self._places.target(event.route, event.target)
        return None
