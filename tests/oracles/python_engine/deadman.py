"""`deadman`: sends a payload in place of a route's commands when these stop coming."""

from __future__ import annotations

import errno
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from router.compiler.metrics import Counters, Report
from router.compiler.program import DeadmanPlan
from tests.oracles.python_engine.delivery import Command, EarlierRefused, Feed, Stale
from tests.oracles.python_engine.timers import Locked, Timer

FeedMaker = Callable[[str, Sequence[str]], Feed]
"""Returns for a route and the names in its TargetPlan.deadmen the call that feeds or disarms all of these at once."""

CommandMaker = Callable[[str, str, Sequence[str]], Command]
"""Returns the Command for an endpoint, a route and the names in its TargetPlan.deadmen."""

_NEVER = 1 << 63

START = 10_000_000_000
"""For so many ns after the start, a new subscriber may be one that was there before: discovery takes less."""

START_AGAIN = 1_000_000_000
"""ns after which a payload of the start that could not leave is sent again."""

GREETING = 500_000_000
"""ns after which a subscriber that was discovered has discovered the publisher as well."""


@dataclass(frozen=True, slots=True)
class _Destination:
    """A datagram that is ready to be sent, and the indexes of its counters."""

    endpoint: str
    datagram: bytes
    send: Callable[[bytes], int]
    sent: int
    errors: int


class Deadman(Timer):
    """The deadman of one route, a state machine with three states.

    unarmed: no command was sent yet, or another route has taken over; nothing is due.
    armed:   trips `timeout` after the last command was sent.
    tripped: has sent the payload when it tripped, and repeats it on the grid of the time at which that was due.

    A command that was sent arms the deadman in any state (`feed`); one of a route that it hands over to disarms it
    (`disarm`). Both are called after the sending has succeeded, under the lock that was taken before it, so the deadman
    sends nothing in between. A command that failed changes nothing: the deadman trips when no other one leaves. One
    that was sent though an earlier one was refused arms the deadman and puts off nothing (`arm`). Calls of a deadman
    that was replaced act on its successor: what waits during a reload is sent afterwards.

    `start` and `greet` send the payload when the router starts, without a change of state. `send` is by endpoint and
    may raise OSError, which is counted and reported. `changed` is called with the route and whether the deadman is now
    tripped. All times in ns of the boot clock.
    """

    def __init__(
        self,
        plan: DeadmanPlan,
        counters: Counters,
        counts: list[int],
        send: Mapping[str, Callable[[bytes], int]],
        report: Callable[[Report], None],
        changed: Callable[[str, bool], None],
    ) -> None:
        self.next_due: int | None = None
        self._greets_until = 0
        self._greets_again = False  # what is due is not a trip, but another message of the start
        self._is_kept_back = False  # a datagram that was sent last has not left
        self._acting = [self]  # shared with all that it has replaced
        self._plan = plan
        self._tripped = False
        self._counts = counts
        self._active = counters.index("deadman_active", plan.route)
        self._trips = counters.index("deadman_trips", plan.route)
        self._destinations = [
            _Destination(
                endpoint,
                datagram,
                send[endpoint],
                counters.index("deadman_datagrams_sent", plan.route, endpoint),
                counters.index("deadman_send_errors", plan.route, endpoint),
            )
            for endpoint, datagram in plan.datagrams
        ]
        self._report = report
        self._changed = changed

    def feed(self, now: int) -> None:
        """Called when a command was sent at `now`."""
        acting = self._acting[0]
        acting.next_due = now + acting._plan.timeout
        acting._greets_again = False
        acting._release()

    def arm(self, now: int) -> None:
        """Called when a command was sent at `now`, and the board is said to have refused an earlier one.

        Nobody knows whether the board obeys this one, and the ICMP message may be forged: so nothing is put off.
        """
        acting = self._acting[0]
        if acting.next_due is None or acting._greets_again:
            acting.next_due, acting._greets_again = now + acting._plan.timeout, False

    def disarm(self, now: int) -> None:
        """Called when a command of a route that it hands over to was sent."""
        acting = self._acting[0]
        acting.next_due = None
        acting._release()

    def start(self, now: int) -> list[str]:
        """Send the payload when the router starts, unless the table says otherwise; return the endpoints reached.

        What moves may still follow the last command of a router that was killed. To be called before anything is sent.
        A network that is not there yet keeps the payload back: it is sent again each second, until it has left for all
        endpoints or a command was sent.
        """
        return self._start(now) if self._plan.at_start else []

    def _start(self, now: int) -> list[str]:
        reached = self._send()
        self._greets_again, self.next_due = self._is_kept_back, now + START_AGAIN if self._is_kept_back else None
        return reached

    def await_subscribers(self, now: int) -> None:
        """As `start`, for publishing: nobody can be reached before subscribers are discovered."""
        self._greets_until = now + START if self._plan.at_start else 0

    def greet(self, now: int) -> list[str]:
        """Send to a new subscriber, shortly after the start and as long as no command was sent.

        Sends again after GREETING: subscriber and publisher do not discover each other at the same time, and best
        effort loses what is sent in between.
        """
        if now >= self._greets_until or (self.next_due is not None and not self._greets_again):
            return []
        self._greets_again, self.next_due = True, now + GREETING
        return self._send()

    def replace(self, earlier: Deadman) -> None:
        """Take over from `earlier`, the deadman of the same route in the previous table: its deadline and state.

        `earlier` keeps only the destinations that are not ours, to which it sends when it ends.
        """
        self._greets_until = earlier._greets_until if self._plan.at_start else 0
        self._acting = earlier._acting
        self._acting[0] = self
        ours = {(each.endpoint, each.send) for each in self._destinations}
        earlier._destinations = [each for each in earlier._destinations if (each.endpoint, each.send) not in ours]
        if earlier.next_due is None or earlier._greets_again:
            if earlier._is_kept_back and self.next_due is None and self._plan.at_start:
                self._greets_again, self.next_due = earlier._greets_again, earlier.next_due
            earlier.next_due = None
            return
        due, earlier.next_due = earlier.next_due, _NEVER  # armed until it ends, so that it sends then
        if self.next_due is not None:  # it was already fed by a later command
            earlier._release()
            return
        self._tripped, now, then = earlier._tripped, earlier._plan, self._plan
        self.next_due = due + (then.repeat - now.repeat if self._tripped else then.timeout - now.timeout)

    def due(self, now: int) -> None:
        due, repeat = self.next_due, self._plan.repeat
        if due is None or now < due:
            return
        if self._greets_again:
            self._start(now)
            return
        # Set before anything can fail. Repetitions that a stalled process has missed are left out.
        self.next_due = due + repeat * ((now - due) // repeat + 1)
        if self._tripped:
            self._send()
            return
        self._tripped = True
        self._counts[self._active] = 1
        self._counts[self._trips] += 1
        self._send()
        self._changed(self._plan.route, True)

    def end(self, now: int) -> None:
        """Send a last time, if armed or tripped."""
        self._greets_until, is_armed = 0, self.next_due is not None and not self._greets_again
        self.next_due = None
        if is_armed:
            self._send()

    def _release(self) -> None:
        if self._tripped:
            self._tripped = False
            self._counts[self._active] = 0
            self._changed(self._plan.route, False)

    def _send(self) -> list[str]:
        """Whoever refuses a datagram, which has left, obeys no earlier command either."""
        sent, self._is_kept_back = [], False
        for destination in self._destinations:
            try:
                destination.send(destination.datagram)
            except OSError as error:
                self._is_kept_back |= error.errno != errno.ECONNREFUSED
                self._counts[destination.errors] += 1
                self._report(Report("deadman", self._plan.route, destination.endpoint, "send_error", error))
            else:
                self._counts[destination.sent] += 1
                sent.append(destination.endpoint)
        return sent


def feeder(deadmen: Mapping[str, Deadman], locked: Locked) -> FeedMaker:
    """`deadmen` are by route; `locked` has one lock for all of them. A deadman is served once its route has a feed."""

    def feed(route: str, names: Sequence[str]) -> Feed:
        return locked(deadmen[names[0]], _feed(deadmen, route, names))

    return feed


def commander(
    send: Mapping[str, Callable[[bytes], int]],
    deadmen: Mapping[str, Deadman],
    locked: Locked,
    clock_ns: Callable[[], int],
) -> CommandMaker:
    """`send` is by endpoint; `deadmen` and `locked` are as in `feeder`. Without deadmen, no lock is taken."""

    def command(endpoint: str, route: str, names: Sequence[str]) -> Command:
        send_one = send[endpoint]
        if not names:

            def send_fresh(data: bytes, expires: int | None) -> int:
                if expires is not None and clock_ns() > expires:
                    raise Stale
                return send_one(data)

            return send_fresh
        feed = _feed(deadmen, route, names)
        arm = deadmen[route].arm if route in names else _arm_none

        def send_fed(data: bytes, expires: int | None) -> int:
            now = clock_ns()
            if expires is not None and now > expires:
                raise Stale
            try:
                size = send_one(data)
            except EarlierRefused:
                arm(now)
                raise
            feed(now)
            return size

        return locked(deadmen[names[0]], send_fed)

    return command


def _arm_none(_: int) -> None:
    """A route that has no deadman only disarms others."""


def _feed(deadmen: Mapping[str, Deadman], route: str, names: Sequence[str]) -> Feed:
    """Return what feeds the deadman of `route` and disarms the others; to be called under their lock."""
    calls = [deadmen[name].feed if name == route else deadmen[name].disarm for name in names]
    if len(calls) == 1:
        return calls[0]

    def call_all(now: int) -> None:
        for call in calls:
            call(now)

    return call_all
