"""Pairs the calls of services with the replies of endpoints.

It knows no clock, thread or ROS: its methods get the time (boot clock, ns), and it acts through `Effects`. A call ends
once: by its reply, when no reply comes in time, at once if its request cannot be sent, or when all calls are ended.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Generic, Protocol, TypeVar

from router.compiler.compiled_table import ANSWERED, ServicePlan
from router.compiler.expressions.tree import ENVELOPE
from router.compiler.metrics import UNSENT_REASONS
from router.types.framing import restored
from router.types.protobuf import Envelope
from router.types.table_envelopes import Envelopes

Caller = TypeVar("Caller")
Caller_contra = TypeVar("Caller_contra", contravariant=True)

NEVER = (1 << 63) - 1
"""When nothing is due."""

HEADER, SIZE_OF_NUMBER = 4, 8
"""Bytes of a message before its number, and of the number."""


class Effects(Protocol[Caller_contra]):
    """What calls do to the world."""

    def send(self, plan: ServicePlan, request: bytes, called_at: int) -> bytes | str:
        """Send a request, CDR bytes after a number. Return the datagram as it was sent, or why it is lost."""

    def send_again(self, plan: ServicePlan, datagram: bytes) -> str | None:
        """Send a datagram again. Return why it is lost."""

    def answer(self, plan: ServicePlan, caller: Caller_contra, response: bytes) -> None:
        """Send the response, CDR bytes, to the caller."""

    def ended(self, plan: ServicePlan, outcome: str, duration: int) -> None:
        """Count a call that has ended after `duration` ns: one of CALL_OUTCOMES."""

    def unmatched(self, plan: ServicePlan, number: int | None) -> None:
        """Count a reply that no call waits for. `number` is the value of `match`, None without one."""


@dataclass(eq=False, slots=True)
class _Call(Generic[Caller]):
    plan: ServicePlan
    caller: Caller
    number: int | None
    """The value of `match`, None without one."""
    began: int
    datagram: bytes
    due: int
    retries: int
    """How often the request may still be sent again."""


class Calls(Generic[Caller]):
    """The open calls of the services of a table. Not thread-safe.

    `numbers` are those of an earlier table: a late reply to one of its calls then answers no call of this one. Services
    that had none begin after `first`.
    """

    def __init__(
        self,
        plans: Iterable[ServicePlan],
        envelopes: Envelopes,
        effects: Effects[Caller],
        numbers: Mapping[str, int] = MappingProxyType({}),
        first: int = 0,
    ) -> None:
        self._plans = {plan.label: plan for plan in plans}
        self._envelopes = envelopes
        self._effects = effects
        self._open: list[_Call[Caller]] = []
        """The oldest call is first."""
        self.numbers = {label: numbers.get(label, first) for label in self._plans}
        """The number of the last call of each service."""
        self._groups: dict[tuple[str, str], list[str]] = {}
        for label, plan in self._plans.items():
            self._groups.setdefault(plan.group, []).append(label)
        self._matched: set[tuple[str, str]] = set()
        """The groups in which an earlier service has taken the present reply."""

    # input

    def call(self, label: str, caller: Caller, request: bytes, called_at: int, now: int) -> None:
        """Take a call: `request` are CDR bytes. `called_at` is the client's wall clock (ns)."""
        plan = self._plans[label]
        if plan.match is None and self._find(plan, None) is not None:
            self._end(plan, caller, "busy", now, now)
            return
        sent = self._effects.send(plan, _with_number(request, self._next(label)), called_at)
        if isinstance(sent, str):
            self._end(plan, caller, "unsent" if sent in UNSENT_REASONS else "refused", now, now)
            return
        number = number_in(self._envelopes.to(plan.endpoint), sent, plan.match) if plan.match is not None else None
        self._open.append(_Call(plan, caller, number, now, sent, now + plan.timeout, plan.retries))

    def reply(self, label: str, message: bytes, now: int) -> None:
        """Take a reply for a service: the response, after a number. It answers the oldest call with that number.

        Services of a group get it in turn.
        """
        plan = self._plans.get(label)
        if plan is None:  # of an earlier table
            return
        services = self._groups[plan.group]
        if label == services[0]:
            self._matched.discard(plan.group)
        number = _number_of(message) if plan.match is not None else None
        call = self._find(plan, number)
        if call is not None and call.plan is plan:
            self._open.remove(call)
            self._matched.add(plan.group)
            self._effects.answer(plan, call.caller, _without_number(message))
            self._effects.ended(plan, ANSWERED, now - call.began)
        elif label == services[-1] and call is None and plan.group not in self._matched:
            self._effects.unmatched(plan, number)

    def serve(self, now: int) -> None:
        """Send again, or end, the calls that are due."""
        for call in [each for each in self._open if each.due <= now]:
            lost = None
            if call.retries:
                call.retries -= 1
                call.due = now + call.plan.timeout
                lost = self._effects.send_again(call.plan, call.datagram)
            else:
                lost = "timed_out"
            if lost is not None:
                self._open.remove(call)
                self._end(call.plan, call.caller, lost if lost == "timed_out" else "unsent", call.began, now)

    def cancel(self, label: str, caller: Caller, now: int) -> None:
        """End a call that is not sent any more."""
        self._end(self._plans[label], caller, "cancelled", now, now)

    def end(self, now: int) -> None:
        """End all calls."""
        calls, self._open = self._open, []
        for call in calls:
            self._end(call.plan, call.caller, "cancelled", call.began, now)

    # state

    @property
    def due(self) -> int:
        """When to call `serve`."""
        return min((call.due for call in self._open), default=NEVER)

    def open_calls(self) -> Mapping[str, int]:
        """Return the number of open calls of each service, by its name."""
        numbers = {plan.name: 0 for plan in self._plans.values()}
        for call in self._open:
            numbers[call.plan.name] += 1
        return numbers

    def _find(self, plan: ServicePlan, number: int | None) -> _Call[Caller] | None:
        """Return the oldest call of the plan's group with this number."""
        return next((call for call in self._open if call.number == number and call.plan.group == plan.group), None)

    def _next(self, label: str) -> int:
        self.numbers[label] = self.numbers[label] % self._plans[label].most + 1
        return self.numbers[label]

    def _end(self, plan: ServicePlan, caller: Caller, outcome: str, began: int, now: int) -> None:
        self._effects.answer(plan, caller, plan.responses[outcome])
        self._effects.ended(plan, outcome, now - began)


def number_in(envelope: Envelope, datagram: bytes, match: tuple[str, ...]) -> int:
    """Return the value of the field `match` in a datagram that the router has sent, as an integer of 64 bits."""
    outer = envelope.message_class.FromString(restored(datagram))
    path = match[1:] if match[0] == ENVELOPE else match
    value: Any = outer if match[0] == ENVELOPE else envelope.payloads_of(outer)[-1][1]
    for name in path:
        value = getattr(value, name)
    return int(value) & (1 << 64) - 1


def _with_number(message: bytes, number: int) -> bytes:
    return message[:HEADER] + struct.pack("<Q", number) + message[HEADER:]


def _number_of(message: bytes) -> int:
    (number,) = struct.unpack_from("<Q", message, HEADER)
    return int(number)


def _without_number(message: bytes) -> bytes:
    return message[:HEADER] + message[HEADER + SIZE_OF_NUMBER :]
