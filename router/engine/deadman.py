"""What is sent in a route's place when its commands stop coming. Knows no clock: whoever calls tells the time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from router.compiler.metrics import Counters
from router.compiler.program import DeadmanPlan
from router.engine.delivery import Feed
from router.engine.machine import Guard
from router.engine.outcome import Report

FeedMaker = Callable[[str, Sequence[str]], Feed]
"""Makes of a route's name, and of the names in TargetPlan.deadmen, the call that tells all these deadmen at once."""

_NEVER = 1 << 63

START = 10_000_000_000
"""How long after the router's start a new subscriber may be one who was there before (ns): discovery takes less."""

GREETING = 500_000_000
"""How long after that the subscriber knows the publisher as well, in ns."""


@dataclass(frozen=True, slots=True)
class _Destination:
    """One datagram that is ready to be sent, and the slots in which it is counted."""

    endpoint: str
    datagram: bytes
    send: Callable[[bytes], int]
    sent: int
    errors: int


class Deadman:
    """A machine with three states.

    unarmed: no command was sent yet, or others have taken over since, and nothing is due.
    armed:   the next thing due is `timeout` after the last command was sent. Then it trips.
    tripped: sends at once, then on the grid of the time at which it was due to trip.

    A command that is sent arms it, whatever its state (`feed`); one of a route that it hands over to disarms it
    (`relieve`). Both are to be called right before the command is sent, not when it begins to wait, so that nothing the
    deadman sends comes behind the command. Called for a deadman that another one has replaced, they act on that one:
    what waited since before a reload is sent after it.

    `begin` and `meet` send the payload at the start of the router, and change no state. `send` is by endpoint and may
    raise OSError, which ends nothing. `changed` hears the route's name and whether the deadman is active now. All times
    in ns of the monotonic clock.
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
        self._meets_until = 0
        self._greets = False  # what is due is no trip, but the second message to a new subscriber
        self._acting = [self]  # shared with all that it replaced: the one that took the place of them
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
        """A fresh command is about to be sent."""
        acting = self._acting[0]
        acting.next_due = now + acting._plan.timeout
        acting._greets = False
        acting._release()

    def relieve(self, now: int) -> None:
        """A fresh command of a route that it hands over to is about to be sent."""
        acting = self._acting[0]
        acting.next_due = None
        acting._release()

    def begin(self) -> list[str]:
        """The router starts: what moves may go on with the last command of a router that was killed.

        Sends, before anything else is sent, unless the table says that it is silent. Returns the endpoints that it was
        sent to.
        """
        return self._send() if self._plan.at_start else []

    def wait_to_meet(self, now: int) -> None:
        """The router starts: as `begin`, where nobody can be sent to before he is met."""
        self._meets_until = now + START if self._plan.at_start else 0

    def meet(self, now: int) -> list[str]:
        """A new subscriber is there. Sends, shortly after the start and as long as no command was sent.

        Sends again after GREETING: subscriber and publisher do not learn of each other at the same time, and best
        effort loses what is sent between.
        """
        if now >= self._meets_until or (self.next_due is not None and not self._greets):
            return []
        self._greets, self.next_due = True, now + GREETING
        return self._send()

    def inherit(self, earlier: Deadman) -> None:
        """Takes the place of `earlier`, the same route's in another table: armed by its command, tripped if it was.

        `earlier` keeps the destinations that are not ours, for its last word.
        """
        self._meets_until = earlier._meets_until if self._plan.at_start else 0
        self._acting = earlier._acting
        self._acting[0] = self
        ours = {(each.endpoint, each.send) for each in self._destinations}
        earlier._destinations = [each for each in earlier._destinations if (each.endpoint, each.send) not in ours]
        if earlier.next_due is None or earlier._greets:
            earlier.next_due = None
            return
        due, earlier.next_due = earlier.next_due, _NEVER  # it does nothing any more but end
        if self.next_due is not None:  # it has heard of a command already, which was a later one
            earlier._release()
            return
        self._tripped, now, then = earlier._tripped, earlier._plan, self._plan
        self.next_due = due + (then.repeat - now.repeat if self._tripped else then.timeout - now.timeout)

    def due(self, now: int) -> None:
        due, repeat = self.next_due, self._plan.repeat
        if due is None or now < due:
            return
        if self._greets:
            self._greets, self.next_due = False, None
            self._send()
            return
        # Before anything can fail; and what a stalled process has missed is left out, not made up for in a burst.
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
        """Orderly shutdown: sends a last time unless no command ever came. Then nothing is due any more."""
        self._meets_until, is_armed = 0, self.next_due is not None and not self._greets
        self.next_due = None
        if is_armed:
            self._send()

    def _release(self) -> None:
        if self._tripped:
            self._tripped = False
            self._counts[self._active] = 0
            self._changed(self._plan.route, False)

    def _send(self) -> list[str]:
        sent = []
        for destination in self._destinations:
            try:
                destination.send(destination.datagram)
            except OSError as error:
                self._counts[destination.errors] += 1
                self._report(Report("deadman", self._plan.route, destination.endpoint, "send_error", error))
            else:
                self._counts[destination.sent] += 1
                sent.append(destination.endpoint)
        return sent


def feeder(deadmen: Mapping[str, Deadman], guard: Guard) -> FeedMaker:
    """`deadmen` are by route. `guard` makes the call safe: it has one lock for all of them.

    Each is served from when its own route's call was made.
    """

    def feed(route: str, told: Sequence[str]) -> Feed:
        calls = [deadmen[name].feed if name == route else deadmen[name].relieve for name in told]
        first, *others = calls

        def tell(now: int) -> None:
            for call in calls:
                call(now)

        return guard(deadmen[told[0]], tell if others else first)

    return feed
