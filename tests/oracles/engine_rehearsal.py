"""The rehearsal as the Python engine did it: the judge of the stage (`benchmarks/judge_stage.py`).

It makes the events of `router.rehearsal`: each message is served by generated Python.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from router.carrier.state import State
from router.compiler.metrics import Report, Series
from router.compiler.program import DeadmanPlan, Program
from router.datagrams import Peer
from router.rehearsal.rehearsal import EVENTS, START, DeadmanChanged, Dropped, Event, Rejected
from tests.oracles.python_engine import InboundEngine, OutboundEngine
from tests.oracles.python_engine.binding import EngineContext, TimerGroup
from tests.oracles.python_engine.deadman import Deadman, commander
from tests.oracles.python_engine.freshness import Freshness
from tests.oracles.python_engine.pacing import Pacer
from tests.oracles.python_engine.timers import P, R, Timer


class EngineRehearsal:
    """One run of a program, as `router.rehearsal.rehearsal.Rehearsal`."""

    def __init__(self, program: Program, start_ns: int = START) -> None:
        self.now = start_ns
        self.events: list[Event] = []
        self.ahead = 0
        self._timers: list[Timer] = []
        self._arrived_at: int | None = None
        self._data = b""
        self._counts = _ObservedCounts(self._count)
        self._inbound, self._outbound = Freshness(), Freshness()
        self._state = State()
        self._deadmen: Mapping[str, Deadman] = {}
        self.reload(program)

    def datagram(self, listener: str, peer: Peer, data: bytes, arrived_ns: int | None = None) -> None:
        self._arrived_at = arrived_ns
        self._receive[listener](data, peer)

    def ros(self, topic: str, cdr: bytes, sent_ns: int | None = None) -> None:
        self._take[topic](cdr, self._wall() if sent_ns is None else sent_ns, False)

    def advance(self, to_ns: int) -> None:
        while (due := self._next_due()) is not None and due <= to_ns:
            self.now = max(self.now, due)
            for timer in reversed(self._timers):  # as a TimerThread: the last may hand on to earlier ones
                if timer.next_due is not None and timer.next_due <= self.now:
                    timer.due(self.now)
        self.now = max(self.now, to_ns)

    def set_clock(self, ahead_ns: int) -> None:
        self.ahead = ahead_ns

    def reload(self, program: Program) -> None:
        """What the router did with its Python plane: state goes along by key, and what is left ends."""
        before, state = self._deadmen, State(self._state)
        self._counts.observe(program)
        deadmen = {plan.route: self._deadman(plan, program, state) for plan in program.deadmen}
        pacers = {to.name: self._pacer(to.name, to.bandwidth, state) for to in program.senders if to.bandwidth}
        context = self._context(program, state, deadmen, pacers)
        inbound = InboundEngine(
            program, context, {plan.name: self._arrival for plan in program.listeners}, self._inbound
        )
        outbound = OutboundEngine(program, context, self._outbound)
        self._receive = {plan.name: inbound.receiver(plan.name) for plan in program.listeners}
        self._take = {plan.label: outbound.taker(plan.label) for plan in program.subscriptions}
        for route, deadman in deadmen.items():
            if before.get(route, deadman) is not deadman:
                deadman.replace(before[route])
        left = [timer for timer in reversed(self._timers) if any(timer is each for each in state.left())]
        for timer in left:
            self._timers.remove(timer)
        for timer in [each for each in left if not isinstance(each, Deadman)]:
            timer.end(self.now)
        places = {(each.route, target.label) for each in program.routes for target in each.targets}
        for pacer in pacers.values():
            pacer.keep_only(self.now, places)
        for deadman in [each for each in left if isinstance(each, Deadman)]:  # after the commands that waited
            deadman.end(self.now)
        state.forget_previous()
        self._state, self._deadmen = state, deadmen

    def close(self) -> None:
        last = [timer for timer in self._timers if isinstance(timer, Deadman)]
        for timer in [each for each in reversed(self._timers) if each not in last] + last[::-1]:
            timer.end(self.now)

    def _next_due(self) -> int | None:
        return min((timer.next_due for timer in self._timers if timer.next_due is not None), default=None)

    def _wall(self) -> int:
        return self.now + self.ahead

    def _arrival(self) -> int:
        return self._wall() if self._arrived_at is None else self._arrived_at

    def _deadman(self, plan: DeadmanPlan, program: Program, state: State) -> Deadman:
        send = dict.fromkeys((endpoint for endpoint, _ in plan.datagrams), self._send)

        def deadman() -> Deadman:
            return Deadman(plan, program.counters, self._counts, send, self._report, self._deadman_changed)

        return state.keep(("deadman", plan), deadman)

    def _pacer(self, endpoint: str, bandwidth: int, state: State) -> Pacer:
        pacer = state.keep(("pacer", endpoint, bandwidth), lambda: Pacer(bandwidth))
        if pacer not in self._timers:
            self._timers.append(pacer)  # before what hands on to it
        return pacer

    def _context(
        self, program: Program, state: State, deadmen: Mapping[str, Deadman], pacers: Mapping[str, Pacer]
    ) -> EngineContext:
        send = {to.name: self._send for to in program.senders}
        group = TimerGroup(self._counts, self._locked)
        return EngineContext(
            counts=self._counts,
            send=send,
            publish={plan.label: self._publish for plan in program.publishers},
            wanted={plan.label: [True] for plan in program.publishers},
            report=self._report,
            clock_ns=lambda: self.now,
            wall_ns=self._wall,
            pacing=group,
            holding=group,
            collecting=group,
            command=commander(send, deadmen, self._locked, lambda: self.now),
            pacers=pacers,
            boards=program.boards,
            state=state,
        )

    def _locked(self, timer: Timer, call: Callable[P, R]) -> Callable[P, R]:
        if timer not in self._timers:
            self._timers.append(timer)
        return call

    def _send(self, data: bytes) -> int:
        self._data = data
        return len(data)

    def _publish(self, cdr: bytes) -> None:
        self._data = bytes(cdr)

    def _count(self, series: Series) -> None:
        """Make an event of what is counted: only the counters have both the route and the target."""
        self.events.append(EVENTS[series.metric](self.now, series.labels, self._data))

    def _report(self, report: Report) -> None:
        """Add to the event of the last count what the engine reports about it."""
        event = self.events[-1]
        if isinstance(event, (Dropped, Rejected)):
            self.events[-1] = replace(event, detail=report.detail or str(report.error or ""))

    def _deadman_changed(self, route: str, active: bool) -> None:
        self.events.append(DeadmanChanged(self.now, route, active))


class _ObservedCounts(list[int]):
    """The counts of programs that continue each other, with a call for each series of an event that is counted."""

    def __init__(self, counted: Callable[[Series], None]) -> None:
        super().__init__()
        self._series: dict[int, Series] = {}
        self._counted = counted

    def observe(self, program: Program) -> None:
        program.counters.grow(self)
        self._series |= {index: series for series, index in program.counters.series() if series.metric in EVENTS}

    def __setitem__(self, index, value) -> None:  # type: ignore[no-untyped-def]  # it is never a slice
        super().__setitem__(index, value)
        if index in self._series:
            self._counted(self._series[index])
