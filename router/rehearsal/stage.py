"""A rehearsal whose calls of services are paired with their replies, on its clock.

The router's own `services` decide which reply answers which call, what is sent again, and which calls end without a
reply. Every service that an endpoint calls has a server.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

from router.compiler.compiled_table import ANSWERED, CalledPlan, CompiledTable, ServicePlan
from router.rehearsal.rehearsal import Dropped, Event, Published, Rehearsal, Sent, Unanswered
from router.services.asking import Asking
from router.services.calls import HEADER, Calls

UNMATCHED = "unmatched"
"""Why a reply is dropped that no call waits for."""


class Stage(Rehearsal):
    """A rehearsal of one program. It is the effects of its calls: see `Effects` in `services`.

    A response for a caller, and a request of an endpoint, are messages Published for the label of their service.
    """

    def __init__(self, program: CompiledTable) -> None:
        """Start the program. Raises StartError if the carrier's library is missing."""
        super().__init__(program)
        self._begin()

    def _begin(self) -> None:
        program = self._program
        self._calls = Calls[None](program.services, program.envelopes, self)
        self._asking = Asking(program.called, self)
        self._asked = Counter[str]()
        """How often each service was called by endpoints; the calls are numbered."""
        self._pairing: Published | None = None
        """The message that is being paired."""

    # input

    def call(self, label: str, request: bytes, called_ns: int) -> None:
        """Call a service: the CDR bytes of a request that a client sent at `called_ns`."""
        self._calls.call(label, None, request, called_ns, self.now)

    def respond(self, label: str, response: bytes) -> None:
        """Respond to the oldest open call of an endpoint. Without one, the response is ignored, as a late one is."""
        plan = next(plan for plan in self._program.called if plan.label == label)
        number = self._asked[label] - self._asking.open_requests()[plan.name] + 1
        self._asking.response(label, number, response, self.now)

    def advance(self, to_ns: int) -> None:
        while (due := min(self._calls.due, self._asking.due)) <= to_ns:
            super().advance(due)
            self._calls.serve(self.now)
            self._asking.serve(self.now)
        super().advance(to_ns)

    def restart(self) -> None:
        super().restart()
        self._begin()

    def close(self) -> None:
        """End all calls, then stop as the rehearsal does."""
        self._calls.end(self.now)
        self._asking.end(self.now)
        super().close()

    # pairing

    def _read(self) -> None:
        """Read what has happened, and pair the messages for services."""
        before = len(self.events)
        super()._read()
        paired = [each for each in self.events[before:] if isinstance(each, Published) and each.target in self._leading]
        for message in paired:
            self.events.remove(message)
            self._pair(message)

    def _pair(self, message: Published) -> None:
        self._pairing = message
        whole = message.data[:HEADER] + message.leading + message.data[HEADER:]
        self._calls.reply(message.target, whole, self.now)
        self._asking.request(message.target, whole, self.now)
        self._pairing = None

    def _since(self, before: int, label: str) -> bytes | str:
        """Return the datagram that the route of a service has sent since then, or why it has not."""
        for event in self.events[before:]:
            if isinstance(event, Sent) and event.route == label:
                return event.data
            if isinstance(event, Dropped) and event.route == label:
                return event.reason
        raise AssertionError(label)

    def _publish(self, label: str, message: bytes) -> None:
        route = self._pairing.route if self._pairing is not None else label
        self.events.append(Published(self.now, route, label, message))

    # effects of calls

    def send(self, plan: ServicePlan, request: bytes, called_at: int) -> bytes | str:
        before = len(self.events)
        self.ros(plan.label, request, called_at)
        return self._since(before, plan.label)

    def send_again(self, plan: ServicePlan, datagram: bytes) -> str | None:
        before = len(self.events)
        self.repeat(plan.label, datagram)
        lost = self._since(before, plan.label)
        return lost if isinstance(lost, str) else None

    def answer(self, plan: ServicePlan, caller: None, response: bytes) -> None:
        self._publish(plan.label, response)

    def ended(self, plan: ServicePlan, outcome: str, duration: int) -> None:
        if outcome != ANSWERED:
            self.events.append(Unanswered(self.now, plan.label, outcome))

    def unmatched(self, plan: ServicePlan, number: int | None) -> None:
        assert self._pairing is not None  # noqa: S101 - a reply
        detail = f"number {number}" if number is not None else ""
        self.events.append(Dropped(self.now, self._pairing.route, plan.label, UNMATCHED, detail))

    # effects of requests of endpoints

    def ask(self, plan: CalledPlan, request: bytes) -> int:
        self._publish(plan.label, request)
        self._asked[plan.label] += 1
        return self._asked[plan.label]

    def reply(self, plan: CalledPlan, message: bytes, *, is_response: bool) -> bool:
        before, topic = len(self.events), plan.label if is_response else plan.failed
        self.ros(topic, message)
        sent = self._since(before, plan.label)
        self.events[before:] = [_of_route(topic, event) for event in self.events[before:]]
        return not isinstance(sent, str)

    def finished(self, plan: CalledPlan, outcome: str, duration: int) -> None:
        if outcome != ANSWERED:
            self.events.append(Unanswered(self.now, plan.label, outcome))


def _of_route(route: str, event: Event) -> Event:
    """Return the event of a reply as of this route: what `on_timeout` says is no response."""
    return replace(event, route=route) if isinstance(event, (Sent, Dropped)) else event
