"""The deadmen of what gateways let in: they publish, in a thread of their own, as that may block in the middleware."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

from router.app.counts import ThreadCounts
from router.app.plane import log_start
from router.app.state import State
from router.app.timers import TimerThread
from router.clock import boottime_ns
from router.compiler.program import DeadmanPlan, Program
from router.engine.deadman import Deadman, FeedMaker, feeder
from router.observe.reports import Reporter
from router.ros.router_node import RouterNode

Send = Callable[[bytes], int]


class GatewayDeadmen:
    """The thread, and the deadmen of the running program by name."""

    def __init__(self, counts: ThreadCounts, reporter: Reporter, changed: Callable[[str, bool], None]) -> None:
        self.now: Mapping[str, Deadman] = {}
        self._counts = counts
        self._reporter = reporter
        self._changed = changed
        self._thread = TimerThread("inbound deadman", reporter.failed)
        self._thread.start()

    def build(self, program: Program, ros: RouterNode, state: State) -> dict[str, Deadman]:
        """The deadmen of a program, by name."""
        return {plan.route: self._deadman(plan, program, ros, state) for plan in inbound_deadmen(program)}

    def _deadman(self, plan: DeadmanPlan, program: Program, ros: RouterNode, state: State) -> Deadman:
        send = {
            topic: state.keep(("sender to topic", topic), partial(_sender_to, ros, topic))
            for topic, _ in plan.datagrams
        }

        def deadman() -> Deadman:
            counts = self._counts.gateway_deadmen
            return Deadman(plan, program.counters, counts, send, self._reporter.report, self._changed)

        return state.keep(("deadman", plan, tuple(send[name] for name, _ in plan.datagrams)), deadman)

    def feed(self, deadmen: Mapping[str, Deadman]) -> FeedMaker:
        return feeder(deadmen, self._thread.locked)

    def start(self, deadmen: Mapping[str, Deadman]) -> None:
        """Have deadmen publish to each subscriber that is discovered shortly after the start."""
        for deadman in deadmen.values():
            self._thread.locked(deadman, deadman.await_subscribers)(boottime_ns())

    def subscriber_joined(self, program: Program, topic: str) -> None:
        for plan in inbound_deadmen(program):
            if topic in dict(plan.datagrams) and plan.route in self.now:
                deadman = self.now[plan.route]
                log_start(plan.route, self._thread.locked(deadman, deadman.greet)(boottime_ns()))

    def check(self, deadmen: Mapping[str, Deadman]) -> None:
        """Raise StuckError if `adopt` would wait for the middleware."""
        if self._successions(deadmen):
            self._thread.check()

    def adopt(self, deadmen: Mapping[str, Deadman], left: Sequence[object]) -> None:
        """Have deadmen with other settings inherit the state of the present ones; end those that are `left`."""
        for deadman, before in self._successions(deadmen):
            self._thread.locked(deadman, deadman.replace)(before)
        self._thread.release(left)
        self.now = deadmen

    def release(self, candidates: Sequence[object]) -> None:
        self._thread.release(candidates)

    def stop(self) -> None:
        self._thread.stop()

    def _successions(self, deadmen: Mapping[str, Deadman]) -> list[tuple[Deadman, Deadman]]:
        """Those with other settings, each with the present one."""
        return [(each, self.now[name]) for name, each in deadmen.items() if self.now.get(name, each) is not each]


def inbound_deadmen(program: Program) -> list[DeadmanPlan]:
    return [each.deadman for gateway in program.gateways for each in gateway.inbound.values() if each.deadman]


def _sender_to(ros: RouterNode, topic: str) -> Send:
    """Return a function that publishes with the interface of a socket's `send`."""

    def send(message: bytes) -> int:
        try:
            ros.publish[topic](message)
        except ros.publish_errors as error:
            raise OSError(f"it cannot be published: {error}") from error
        return len(message)

    return send
