"""Pairs the requests of endpoints with the responses of ROS services that they call.

Like `calls`, it knows no clock, thread or ROS. Each request gets one reply: the service's response, or what
`on_timeout` says, at once if there is no server or too many requests are open.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

from router.compiler.compiled_table import ANSWERED, CalledPlan
from router.services.calls import HEADER, NEVER

MOST_OPEN = 64
"""Open requests of a service: an endpoint may send them faster than a server answers."""


class Effects(Protocol):
    """What requests do to the world."""

    def ask(self, plan: CalledPlan, request: bytes) -> int | None:
        """Call the service with a request, CDR bytes. Return the number of the call; None without a server."""

    def reply(self, plan: CalledPlan, message: bytes, *, is_response: bool) -> bool:
        """Send a reply: a response, or a text that says why there is none, after the kept values. Return success."""

    def finished(self, plan: CalledPlan, outcome: str, duration: int) -> None:
        """Count a request that has ended after `duration` ns: one of CALL_OUTCOMES."""


@dataclass(eq=False, slots=True)
class _Request:
    plan: CalledPlan
    number: int
    kept: bytes
    """The values of the request that its reply needs."""
    began: int
    due: int


class Asking:
    """The open requests of endpoints. Not thread-safe."""

    def __init__(self, plans: Iterable[CalledPlan], effects: Effects) -> None:
        self._plans = {plan.label: plan for plan in plans}
        self._effects = effects
        self._open: list[_Request] = []

    def request(self, label: str, message: bytes, now: int) -> None:
        """Take a request of an endpoint: CDR bytes after the values that are kept."""
        plan = self._plans.get(label)
        if plan is None:  # of an earlier table
            return
        end = HEADER + plan.kept
        kept, request = message[HEADER:end], message[:HEADER] + message[end:]
        if sum(each.plan is plan for each in self._open) >= MOST_OPEN:
            self._fail(plan, kept, "busy", now, now)
        elif (number := self._effects.ask(plan, request)) is None:
            self._fail(plan, kept, "unsent", now, now)
        else:
            self._open.append(_Request(plan, number, kept, now, now + plan.timeout))

    def response(self, label: str, number: int, message: bytes, now: int) -> None:
        """Take a response of a service: CDR bytes. One that comes too late is ignored."""
        for request in self._open:
            if request.number == number and request.plan.label == label:
                self._open.remove(request)
                response = message[:HEADER] + request.kept + message[HEADER:]
                is_sent = self._effects.reply(request.plan, response, is_response=True)
                self._effects.finished(request.plan, ANSWERED if is_sent else "refused", now - request.began)
                return

    def serve(self, now: int) -> None:
        """End the requests that are due."""
        for request in [each for each in self._open if each.due <= now]:
            self._open.remove(request)
            self._fail(request.plan, request.kept, "timed_out", request.began, now)

    def end(self, now: int) -> None:
        """End all requests."""
        requests, self._open = self._open, []
        for request in requests:
            self._fail(request.plan, request.kept, "cancelled", request.began, now)

    @property
    def due(self) -> int:
        """When to call `serve`."""
        return min((request.due for request in self._open), default=NEVER)

    def open_requests(self) -> Mapping[str, int]:
        """Return the number of open requests of each service, by its name."""
        return {plan.name: sum(each.plan is plan for each in self._open) for plan in self._plans.values()}

    def _fail(self, plan: CalledPlan, kept: bytes, outcome: str, began: int, now: int) -> None:
        text = plan.reasons[outcome].encode() + b"\0"
        message = b"\0\1\0\0" + kept + struct.pack("<I", len(text)) + text
        self._effects.reply(plan, message, is_response=False)
        self._effects.finished(plan, outcome, now - began)
