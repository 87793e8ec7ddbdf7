"""Serves the ROS services of the running program, in a thread of its own.

A service is rare, so its calls are paired with their replies in Python. Requests and replies are mapped natively, like
all other messages, and no native thread waits for this one.
"""

from __future__ import annotations

import os
import select
from bisect import bisect_left
from collections import deque
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from threading import RLock
from typing import TYPE_CHECKING

from router.app.change import Change
from router.clock import boottime_ns
from router.compiler.metrics import CALL_BOUNDS_NS, CALL_OUTCOMES, HISTOGRAM_CELLS, Report
from router.log import fault, logger
from router.services.calls import NEVER, Calls
from router.threads import StuckError, Thread, join_or_abandon

if TYPE_CHECKING:
    import ctypes

    from router import declared as c
    from router.app.counts import ThreadCounts
    from router.app.plane import Plane
    from router.app.topics import Topics
    from router.carrier.events import Reply
    from router.compiler.compiled_table import CompiledTable, ServicePlan
    from router.observe.reports import Reporter
    from router.ros.services import Request, ServedService

_LOOK_S = 0.25
"""The longest time between two comparisons of the clocks."""
_PATIENCE_S = 1.0
"""How long a reload waits for the thread while it may be stuck in the middleware."""
_TURN = 32
"""Requests of one service before others are served."""


@dataclass(slots=True)
class ServiceChange:
    """All services of the next program by name, the newly opened ones, and the unused old ones."""

    served: dict[str, ServedService]
    opened: list[ServedService]
    unused: list[ServedService] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class _Running:
    """What calls use of a program: the routes of requests, and the counters, both by service."""

    routes: Mapping[str, ctypes.Array[c.RosRoute]]
    counters: Mapping[tuple[str, ...], int]

    @classmethod
    def of(cls, program: CompiledTable, routes: Mapping[str, ctypes.Array[c.RosRoute]]) -> _Running:
        metrics = "service_calls_open", "service_call_seconds", "service_retries", "service_replies_unmatched"
        index, counters = program.counters.index, dict[tuple[str, ...], int]()
        for plan in program.services:
            counters |= {(metric, plan.name): index(metric, plan.name) for metric in metrics}
            counters |= {(plan.name, outcome): index("service_calls", plan.name, outcome) for outcome in CALL_OUTCOMES}
        return cls(routes, counters)


class Services:
    """The services of the running program. It is the effects of its calls (`services.calls.Effects`)."""

    def __init__(self, topics: Topics, plane: Plane, counts: ThreadCounts, reporter: Reporter) -> None:
        self._topics, self._reporter = topics, reporter
        self._sender = plane.requests
        self._counts = self._sender.counts
        self._lock = RLock()  # of everything below
        self._served: dict[str, ServedService] = {}
        self._calls: Calls[tuple[ServedService, Request]] | None = None
        self._running = _Running({}, {})
        self._replies: deque[Reply] = deque()
        self._eventfd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._thread: Thread | None = None
        self._is_stopping = False
        plane.replied = self.replied

    def replied(self, reply: Reply) -> None:
        """Take a reply, in any thread. Returns at once."""
        self._replies.append(reply)
        os.eventfd_write(self._eventfd, 1)

    # adoption of another program

    def prepare(self, change: Change) -> None:
        """Open the services that are not open yet. Raises StartError, or StuckError if the thread is stuck."""
        self._acquire()
        self._lock.release()
        served, opened = dict[str, "ServedService"](), list["ServedService"]()
        with ExitStack() as undo:
            for plan in change.program.services:
                kept = self._served.get(plan.name)
                if kept is None or _is_other(kept.plan, plan):
                    assert self._topics.node is not None  # noqa: S101 - opened for the services
                    kept = self._topics.node.open_service(plan, self._eventfd)
                    opened.append(kept)
                    undo.callback(kept.close)
                served[plan.name] = kept
            undo.pop_all()
        change.services = ServiceChange(served, opened)

    def undo(self, change: Change) -> None:
        """Close the services that `prepare` has opened."""
        for opened in change.services.opened if change.services else ():
            opened.close()
        change.services = None

    def adopt(self, change: Change) -> None:
        """End the open calls, and serve those of the next program."""
        assert change.services is not None  # noqa: S101 - prepared
        assert change.image is not None  # noqa: S101 - prepared
        served, program = change.services.served, change.program
        with self._lock:
            if self._calls is not None:
                self._calls.end(boottime_ns())
                self._note_open()
            change.services.unused = [each for name, each in self._served.items() if served.get(name) is not each]
            self._served = served
            self._running = _Running.of(program, change.image.requests())
            self._calls = Calls(program.services, program.envelopes, self)
        if served and self._thread is None:
            self._thread = Thread(self._run, "services")
            self._thread.start()
        os.eventfd_write(self._eventfd, 1)

    def finish(self, change: Change) -> None:
        """Close the services that only the earlier program had."""
        for unused in change.services.unused if change.services else ():
            unused.close()

    def _acquire(self) -> None:
        if not self._lock.acquire(timeout=_PATIENCE_S):
            raise StuckError("the thread that serves ROS services is stuck in the middleware")

    # the thread

    def _run(self) -> None:
        poll = select.poll()
        poll.register(self._eventfd, select.POLLIN)
        while not self._is_stopping:
            poll.poll(self._patience())
            with suppress(BlockingIOError):
                os.eventfd_read(self._eventfd)
            with self._lock:
                try:
                    self._serve()
                except Exception as error:  # noqa: BLE001 a bug is logged; later calls are still served
                    fault(error, "lost a call of a service").log()

    def _patience(self) -> float:
        """Return how long to wait, in ms."""
        due = self._calls.due if self._calls is not None else NEVER
        wait = (due - boottime_ns()) / 1e6 if due != NEVER else _LOOK_S * 1e3
        return max(0.0, min(wait + 1, _LOOK_S * 1e3))

    def _serve(self) -> None:
        assert self._calls is not None  # noqa: S101 - the thread runs
        self._sender.look()
        while self._replies:
            reply = self._replies.popleft()
            self._calls.reply(reply.service, reply.message, boottime_ns())
        for served in self._served.values():
            for _ in range(_TURN):
                if (request := served.take()) is None:
                    break
                caller = served, request
                self._calls.call(served.plan.label, caller, request.message, request.called_at, boottime_ns())
            else:
                os.eventfd_write(self._eventfd, 1)
        self._calls.serve(boottime_ns())
        self._note_open()

    def _note_open(self) -> None:
        if self._calls is not None:
            for name, number in self._calls.open_calls().items():
                self._counts[self._running.counters["service_calls_open", name]] = number

    # effects of calls

    def send(self, plan: ServicePlan, request: bytes, called_at: int) -> bytes | str:
        return self._sender.send(self._running.routes[plan.label], request, called_at)

    def send_again(self, plan: ServicePlan, datagram: bytes) -> str | None:
        self._counts[self._running.counters["service_retries", plan.name]] += 1
        return self._sender.send_again(self._running.routes[plan.label], datagram)

    def answer(self, plan: ServicePlan, caller: tuple[ServedService, Request], response: bytes) -> None:
        served, request = caller
        try:
            served.answer(request, response)
        except RuntimeError as error:  # of rcl: the client has gone
            logger.warning("a response could not be sent", service=plan.name, problem=str(error))

    def ended(self, plan: ServicePlan, outcome: str, duration: int) -> None:
        counters = self._running.counters
        self._counts[counters[plan.name, outcome]] += 1
        histogram = counters["service_call_seconds", plan.name]
        self._counts[histogram + bisect_left(CALL_BOUNDS_NS, duration)] += 1
        self._counts[histogram + HISTOGRAM_CELLS - 1] += duration
        if outcome in ("timed_out", "unsent", "refused", "busy"):
            self._reporter.report(Report("call", plan.name, plan.endpoint, outcome))

    def unmatched(self, plan: ServicePlan, number: int | None) -> None:
        self._counts[self._running.counters["service_replies_unmatched", plan.name]] += 1
        detail = f"number {number}" if number is not None else ""
        self._reporter.report(Report("reply", plan.name, "", "unmatched", None, detail))

    # stopping

    def close(self) -> None:
        """End all calls, and close the services."""
        self._is_stopping = True
        os.eventfd_write(self._eventfd, 1)
        if self._thread is not None and not join_or_abandon(self._thread):
            self._topics.leave_open()
            return
        if self._calls is not None:
            self._calls.end(boottime_ns())
            self._note_open()
        for served in self._served.values():
            served.close()
        self._sender.close()


def _is_other(kept: ServicePlan, plan: ServicePlan) -> bool:
    """Return whether ROS needs another service."""
    names = (kept.ros_name, kept.type_name, kept.definitions)
    return names != (plan.ros_name, plan.type_name, plan.definitions)
