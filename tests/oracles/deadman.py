"""The oracle of deadmen: the rules of `deadman.h` with sets, lists and no lock. Slow and plain.

A deadman is in one of three states. *Unarmed*: no command was sent yet, or another route has taken over. *Armed*: it
trips `timeout` after the last command. *Tripped*: it has sent when that was over, and repeats that on the grid of this
time. Endpoints are armed one by one, and a deadman sends to those that are. A command arms the one that it goes to in
any state, one of a route that it hands over to disarms it; endpoints that the route never commands go with the others.
A command that failed changes nothing, and one that left though an earlier one was refused arms what is unarmed and puts
off nothing.

At the start, and each second from then on, an endpoint gets the payloads until a command goes to it, or once more after
it was heard.
"""

from __future__ import annotations

import errno
from collections import Counter
from dataclasses import dataclass, field

from router.compiler.compiled_table import DeadmanPlan

START, START_AGAIN, GREETING = 10_000_000_000, 1_000_000_000, 500_000_000

Event = tuple[str, str, str, int]
"""An event: what happened, the deadman's route, the endpoint and the errno."""


@dataclass(eq=False)
class Deadman:
    plan: DeadmanPlan
    outlets: dict[str, tuple[bytes, ...]]
    armed: set[str] = field(default_factory=set)
    unstarted: set[str] = field(default_factory=set)
    """What gets the payloads of the start when that is due next."""
    started: dict[str, int] = field(default_factory=dict)
    """What has got them, and how often it had been heard before."""
    has_tripped: bool = False
    due: int | None = None
    start_due: int | None = None
    greets_until: int = 0
    greets_again: int | None = None
    ends_when_due: bool = False
    successor: Deadman | None = None

    @property
    def acting(self) -> Deadman:
        return self.successor.acting if self.successor else self

    @property
    def names(self) -> set[str]:
        return {name for name, _ in self.plan.datagrams}

    @property
    def dues(self) -> list[int]:
        return [due for due in (self.due, self.start_due) if due is not None]

    def end_start(self, to: set[str]) -> None:
        self.unstarted -= to
        if not self.unstarted:
            self.start_due = None

    def with_followers(self, armed: set[str]) -> set[str]:
        return armed | self.plan.following if armed - self.plan.following else armed


@dataclass
class Deadmen:
    """The deadmen of a group. Sending to `broken` endpoints fails; `refused` ones have refused a datagram."""

    deadmen: list[Deadman] = field(default_factory=list)
    sent: list[tuple[str, bytes]] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    counts: Counter[tuple[str, ...]] = field(default_factory=Counter)
    broken: set[str] = field(default_factory=set)
    refused: set[str] = field(default_factory=set)
    heard: Counter[str] = field(default_factory=Counter)

    def add(self, plan: DeadmanPlan) -> Deadman:
        deadman = Deadman(plan, dict(plan.datagrams))
        self.deadmen.insert(0, deadman)
        return deadman

    def remove(self, deadman: Deadman) -> None:
        self.deadmen.remove(deadman)

    @property
    def next_due(self) -> int | None:
        return min((due for each in self.deadmen for due in each.dues), default=None)

    def command(self, now: int, feeds: list[tuple[Deadman, bool]], endpoint: str, data: bytes) -> None:
        error = self._send(endpoint, data)
        if error == errno.ENOTSOCK:
            return
        for named, disarms in feeds:
            if not (error and disarms):
                self._feed(now, named, {endpoint} if endpoint in named.names else named.names, disarms, bool(error))

    def _feed(self, now: int, named: Deadman, to: set[str], disarms: bool, is_refused: bool) -> None:
        deadman = named.acting
        if deadman is not named:
            for each in self.deadmen:
                if each.acting is deadman and each is not deadman:
                    own = to & each.outlets.keys()
                    each.armed = each.armed - own if disarms else each.armed | own
            to &= deadman.names
            if not to:
                return
        if disarms:
            self._disarm(deadman, to)
            return
        deadman.end_start(to | deadman.plan.following)
        if not (is_refused and deadman.armed):
            deadman.due = now + deadman.plan.timeout
        deadman.armed |= to | deadman.plan.following
        if not is_refused:
            self._release(deadman)

    def _disarm(self, deadman: Deadman, to: set[str]) -> None:
        deadman.end_start(to)
        deadman.armed -= to
        if deadman.armed - deadman.plan.following:
            return
        deadman.armed = set()
        deadman.due = None
        self._release(deadman)

    def serve(self, now: int) -> None:
        for deadman in self.deadmen:
            if deadman.start_due is not None and deadman.start_due <= now:
                self._send_at_start(deadman, now)
            if deadman.due is not None and deadman.due <= now:
                self.serve_one(deadman, deadman.due, now)

    def serve_one(self, deadman: Deadman, due: int, now: int) -> None:
        if deadman.ends_when_due:
            self.end(deadman)
        else:
            repeat, trips = deadman.plan.repeat, not deadman.has_tripped
            deadman.due = due + repeat * (1 + (now - due) // repeat)  # repeats missed by a stalled process are skipped
            deadman.has_tripped = True
            self.counts["trips", deadman.plan.route] += trips
            self._send_all(deadman, deadman.armed)
            if trips:
                self._tell("tripped", deadman)

    def start(self, deadman: Deadman, now: int) -> list[str]:
        """Send the payload at the router's start, without changing the state. Return the endpoints reached."""
        if not deadman.plan.at_start:
            return []
        deadman.unstarted, deadman.started = {*deadman.outlets}, {}
        return self._send_at_start(deadman, now)

    def _send_at_start(self, deadman: Deadman, now: int) -> list[str]:
        to, before, started = deadman.unstarted, Counter(self.heard), dict(deadman.started)
        errors = self._send_all(deadman, to)
        failed = {name for name, each in errors.items() if {*each} - {0, errno.ECONNREFUSED}}
        for name in to - failed - started.keys():
            deadman.started[name] = before[name]
        again = {name for name in to if name in failed or started.get(name, before[name]) == before[name]}
        times = [deadman.greets_again, now + START_AGAIN if again else None]
        deadman.unstarted = again if deadman.greets_again is None else {*deadman.outlets}
        deadman.start_due = min((time for time in times if time is not None), default=None)
        deadman.greets_again = None
        return [endpoint for endpoint, each in errors.items() if not any(each)]

    def await_subscribers(self, deadman: Deadman, now: int) -> None:
        deadman.greets_until = now + START if deadman.plan.at_start else 0

    def greet(self, deadman: Deadman, now: int) -> bool:
        """Handle a new subscriber: send at once, and again later, because it may not have discovered us yet."""
        if now >= deadman.greets_until or deadman.armed:
            return False
        deadman.unstarted = {*deadman.outlets}
        deadman.start_due, deadman.greets_again = now, now + GREETING
        return True

    def replace(self, next_one: Deadman, earlier: Deadman) -> None:
        earlier.acting.successor = next_one
        passed, was_armed = earlier.armed & next_one.names, bool(earlier.armed)
        earlier.outlets = {name: data for name, data in earlier.outlets.items() if name not in next_one.names}
        earlier.armed &= earlier.outlets.keys()
        next_one.greets_until = earlier.greets_until if next_one.plan.at_start else 0
        due, earlier.due = earlier.due, None
        if was_armed:
            assert due is not None
            self._pass_on(next_one, earlier, next_one.with_followers(passed), due)
        unstarted, start_due = earlier.unstarted & next_one.names - next_one.armed, earlier.start_due
        earlier.end_start(earlier.unstarted)
        if not next_one.plan.at_start:
            return
        next_one.unstarted |= unstarted
        next_one.started |= {name: earlier.started[name] for name in unstarted & earlier.started.keys()}
        if next_one.unstarted:
            for name, value in (("start_due", start_due), ("greets_again", earlier.greets_again)):
                times = [time for time in (value, getattr(next_one, name)) if time is not None]
                setattr(next_one, name, min(times, default=None))

    def _pass_on(self, next_one: Deadman, earlier: Deadman, passed: set[str], due: int) -> None:
        was_armed = bool(next_one.armed)
        next_one.armed |= passed
        if not passed or (was_armed and earlier.has_tripped):
            self._release(earlier)
            return
        now, then = earlier.plan, next_one.plan
        due += then.repeat - now.repeat if earlier.has_tripped else then.timeout - now.timeout
        if was_armed and not next_one.has_tripped:
            assert next_one.due is not None
            next_one.due = max(due, next_one.due)
            return
        self._release(next_one)
        next_one.due = due
        if earlier.has_tripped:
            earlier.has_tripped, next_one.has_tripped = False, True
            self.counts["active", earlier.plan.route] = 0
            self.counts["active", next_one.plan.route] = 1

    def end(self, deadman: Deadman) -> None:
        """Send a last time to what is armed; also when replaced by a deadman that does not send there."""
        armed, deadman.armed = deadman.armed, set()
        deadman.due, deadman.greets_until = None, 0
        deadman.end_start(deadman.names)
        self._send_all(deadman, armed)

    def end_when_served(self, deadman: Deadman) -> None:
        deadman.ends_when_due, deadman.greets_until = bool(deadman.armed), 0
        deadman.due = 0 if deadman.ends_when_due else None
        deadman.end_start(deadman.names)

    def _send_all(self, deadman: Deadman, to: set[str]) -> dict[str, list[int]]:
        errors = {
            endpoint: [self._send(endpoint, each) for each in datagrams]
            for endpoint, datagrams in deadman.plan.datagrams
            if endpoint in to
        }
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
