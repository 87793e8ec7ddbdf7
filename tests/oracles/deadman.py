"""The oracle of deadmen: the rules of `deadman.h` with sets, lists and no lock. Slow and plain.

A deadman is in one of three states. *Unarmed*: no command was sent yet, or another route has taken over. *Armed*: it
trips `timeout` after the last command. *Tripped*: it has sent when that was over, and repeats that on the grid of this
time. A command arms it in any state, one of a route that it hands over to disarms it. A command that failed changes
nothing, and one that left though an earlier one was refused arms an unarmed deadman and puts off nothing.
"""

from __future__ import annotations

import errno
from collections import Counter
from dataclasses import dataclass, field

from router.compiler.program import DeadmanPlan

START, START_AGAIN, GREETING = 10_000_000_000, 1_000_000_000, 500_000_000

Event = tuple[str, str, str, int]
"""An event: what happened, the deadman's route, the endpoint and the errno."""


@dataclass(eq=False)
class Deadman:
    plan: DeadmanPlan
    outlets: dict[str, tuple[bytes, ...]]
    is_armed: bool = False
    """Armed or tripped."""
    has_tripped: bool = False
    due: int | None = None
    greets_until: int = 0
    greets_again: int | None = None
    ends_when_due: bool = False
    successor: Deadman | None = None

    @property
    def acting(self) -> Deadman:
        return self.successor.acting if self.successor else self


@dataclass
class Deadmen:
    """The deadmen of a group. Sending to `broken` endpoints fails; `refused` ones have refused a datagram."""

    deadmen: list[Deadman] = field(default_factory=list)
    sent: list[tuple[str, bytes]] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    counts: Counter[tuple[str, ...]] = field(default_factory=Counter)
    broken: set[str] = field(default_factory=set)
    refused: set[str] = field(default_factory=set)

    def add(self, plan: DeadmanPlan) -> Deadman:
        deadman = Deadman(plan, dict(plan.datagrams))
        self.deadmen.insert(0, deadman)
        return deadman

    def remove(self, deadman: Deadman) -> None:
        self.deadmen.remove(deadman)

    @property
    def next_due(self) -> int | None:
        return min((each.due for each in self.deadmen if each.due is not None), default=None)

    def command(self, now: int, feeds: list[tuple[Deadman, bool]], endpoint: str, data: bytes) -> None:
        error = self._send(endpoint, data)
        if error == errno.ENOTSOCK:
            return
        for named, disarms in feeds:
            deadman = named.acting
            if error:
                if not disarms and not deadman.is_armed:
                    deadman.is_armed, deadman.due = True, now + deadman.plan.timeout
                continue
            deadman.is_armed, deadman.due = not disarms, None if disarms else now + deadman.plan.timeout
            self._release(deadman)

    def serve(self, now: int) -> None:
        for deadman in self.deadmen:
            if deadman.due is not None and deadman.due <= now:
                self.serve_one(deadman, deadman.due, now)

    def serve_one(self, deadman: Deadman, due: int, now: int) -> None:
        if deadman.ends_when_due:
            self.end(deadman)
        elif not deadman.is_armed:
            self._send_at_start(deadman, now)
        else:
            repeat, trips = deadman.plan.repeat, not deadman.has_tripped
            deadman.due = due + repeat * (1 + (now - due) // repeat)  # repeats missed by a stalled process are skipped
            deadman.has_tripped = True
            self.counts["trips", deadman.plan.route] += trips
            self._send_all(deadman)
            if trips:
                self._tell("tripped", deadman)

    def start(self, deadman: Deadman, now: int) -> list[str]:
        """Send the payload at the router's start, without changing the state. Return the endpoints reached."""
        return self._send_at_start(deadman, now) if deadman.plan.at_start else []

    def _send_at_start(self, deadman: Deadman, now: int) -> list[str]:
        errors = self._send_all(deadman)
        times = [deadman.greets_again]
        if any({*each} - {0, errno.ECONNREFUSED} for each in errors.values()):
            times.append(now + START_AGAIN)
        deadman.due = min((time for time in times if time is not None), default=None)
        deadman.greets_again = None
        return [endpoint for endpoint, each in errors.items() if not any(each)]

    def await_subscribers(self, deadman: Deadman, now: int) -> None:
        deadman.greets_until = now + START if deadman.plan.at_start else 0

    def greet(self, deadman: Deadman, now: int) -> bool:
        """Handle a new subscriber: send at once, and again later, because it may not have discovered us yet."""
        if now >= deadman.greets_until or deadman.is_armed:
            return False
        deadman.due, deadman.greets_again = now, now + GREETING
        return True

    def replace(self, next_one: Deadman, earlier: Deadman) -> None:
        earlier.acting.successor = next_one
        earlier.outlets = {name: data for name, data in earlier.outlets.items() if name not in next_one.outlets}
        next_one.greets_until = earlier.greets_until if next_one.plan.at_start else 0
        due, earlier.due = earlier.due, None
        if due is None:
            return
        if next_one.is_armed:
            self._release(earlier)
        elif earlier.is_armed:
            now, then = earlier.plan, next_one.plan
            next_one.is_armed, next_one.has_tripped = True, earlier.has_tripped
            next_one.due = due + (then.repeat - now.repeat if earlier.has_tripped else then.timeout - now.timeout)
        elif next_one.plan.at_start:
            next_one.due, next_one.greets_again = due, earlier.greets_again

    def end(self, deadman: Deadman) -> None:
        """Send a last time unless unarmed; also when replaced by a deadman that does not send."""
        is_armed, deadman.is_armed = deadman.is_armed, False
        deadman.due, deadman.greets_until = None, 0
        if is_armed:
            self._send_all(deadman)

    def end_when_served(self, deadman: Deadman) -> None:
        deadman.ends_when_due, deadman.greets_until = deadman.is_armed, 0
        deadman.due = 0 if deadman.ends_when_due else None

    def _send_all(self, deadman: Deadman) -> dict[str, list[int]]:
        errors = {endpoint: [self._send(endpoint, each) for each in all_] for endpoint, all_ in deadman.outlets.items()}
        for endpoint, each in errors.items():
            for error in each:
                self.counts["send_errors" if error else "datagrams_sent", deadman.plan.route, endpoint] += 1
                if error:
                    self.events.append(("error", deadman.plan.route, endpoint, error))
        return errors

    def _send(self, endpoint: str, data: bytes) -> int:
        if endpoint in self.broken:
            return errno.ENOTSOCK
        self.sent.append((endpoint, data))
        if endpoint in self.refused:
            self.refused.remove(endpoint)
            return errno.ECONNREFUSED
        return 0

    def _release(self, deadman: Deadman) -> None:
        if deadman.has_tripped:
            deadman.has_tripped = False
            self._tell("released", deadman)

    def _tell(self, what: str, deadman: Deadman) -> None:
        self.counts["active", deadman.plan.route] = int(what == "tripped")
        self.events.append((what, deadman.plan.route, "", 0))
