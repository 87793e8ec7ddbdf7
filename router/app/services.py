"""Serves and calls the ROS services of the running program, in a thread of its own.

A service is rare, so its calls are paired with their replies in Python. Requests and replies are mapped natively, like
all other messages, and no native thread waits for this one.
"""

from __future__ import annotations

import os
import select
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from threading import RLock
from typing import TYPE_CHECKING

from router.app.change import Change
from router.clock import boottime_ns, wall_ns
from router.compiler.call_counters import CallCounters, is_failure
from router.compiler.compiled_table import CalledPlan, ClientCallPlan, ServicePlan
from router.compiler.metrics import Report
from router.log import fault, logger
from router.services.asking import Asking
from router.services.calls import NEVER, Calls
from router.threads import StuckError, Thread, join_or_abandon

if TYPE_CHECKING:
    import ctypes

    from router import declared as c
    from router.app.counts import ThreadCounts
    from router.app.plane import Plane
    from router.app.topics import Topics
    from router.carrier.events import Reply
    from router.compiler.compiled_table import CompiledTable
    from router.observe.reports import Reporter
    from router.ros.router_node import RouterNode
    from router.ros.services import CallingClient, Request, ServedService

_LOOK_S = 0.25
"""The longest time between two comparisons of the clocks."""
_PATIENCE_S = 1.0
"""How long a reload waits for the thread while it may be stuck in the middleware."""
_MS = 1_000_000
_TURN = 32
"""Requests of one service before others are served."""
_MOST_WAITING = 1000
"""Responses that wait for a client: see `router.ros.services`."""


@dataclass(slots=True)
class ServiceChange:
    """All services and clients of the next program by name, the newly opened ones, and the old ones that it lacks."""

    served: dict[str, ServedService] = field(default_factory=dict)
    calling: dict[str, CallingClient] = field(default_factory=dict)
    opened: list[ServedService | CallingClient] = field(default_factory=list)
    ending: list[ServedService] = field(default_factory=list)
    unused: list[CallingClient] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class _Running:
    """What calls use of a program: the routes of messages to endpoints, by label, and the counters, by service."""

    routes: Mapping[str, ctypes.Array[c.RosRoute]]
    counters: Mapping[str, CallCounters]
    retries: Mapping[str, int]
    unmatched: Mapping[str, int]

    @classmethod
    def of(cls, program: CompiledTable, routes: Mapping[str, ctypes.Array[c.RosRoute]]) -> _Running:
        counters, answered = program.counters, [plan.name for plan in program.services]
        return cls(
            routes,
            {name: CallCounters.of(counters, name) for name in program.service_names},
            {name: counters.index("service_retries", name) for name in answered},
            {name: counters.index("service_replies_unmatched", name) for name in answered},
        )


class Services:
    """The services of the running program. It is the effects of its calls: see `Effects` in `services`."""

    def __init__(self, topics: Topics, plane: Plane, counts: ThreadCounts, reporter: Reporter) -> None:
        self._topics, self._reporter = topics, reporter
        self._sender = plane.requests
        self._counts = self._sender.counts
        self._lock = RLock()  # of everything below
        self._served: dict[str, ServedService] = {}
        self._calling: dict[str, CallingClient] = {}
        self._asking: Asking | None = None
        self._calls: Calls[tuple[ServedService, Request]] | None = None
        self._running = _Running({}, {}, {}, {})
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
        change.services = ServiceChange()
        try:
            self._open(change.services, change.program)
        except BaseException:
            self.undo(change)
            raise

    def _open(self, change: ServiceChange, program: CompiledTable) -> None:
        for plan in program.services:
            kept = self._served.get(plan.name)
            if kept is None or _is_other(kept.plan, plan):
                kept = self._node.open_service(plan, self._eventfd)
                change.opened.append(kept)
            change.served[plan.name] = kept
        for called in program.called:
            client = self._calling.get(called.name)
            if client is None or _is_other(client.plan, called):
                client = self._node.open_client(called, self._eventfd)
                change.opened.append(client)
            change.calling[called.name] = client

    @property
    def _node(self) -> RouterNode:
        assert self._topics.node is not None  # noqa: S101 - opened for the services
        return self._topics.node

    def undo(self, change: Change) -> None:
        """Close the services that `prepare` has opened."""
        for opened in change.services.opened if change.services else ():
            opened.close()
        change.services = None

    def adopt(self, change: Change) -> None:
        """End the open calls, and serve those of the next program."""
        assert change.services is not None  # noqa: S101 - prepared
        assert change.image is not None  # noqa: S101 - prepared
        served, calling, program = change.services.served, change.services.calling, change.program
        with self._lock:
            ending = [each for name, each in self._served.items() if served.get(name) is not each]
            self._end(ending)
            change.services.ending = ending
            change.services.unused = [each for name, each in self._calling.items() if calling.get(name) is not each]
            self._served, self._calling = served, calling
            self._running = _Running.of(program, change.image.requests())
            numbers = self._calls.numbers if self._calls is not None else {}
            # Numbers that begin with the time in ms are others than those before a restart.
            self._calls = Calls(program.services, program.envelopes, self, numbers, first=wall_ns() // _MS)
            self._asking = Asking(program.called, self)
        if (served or calling) and self._thread is None:
            self._thread = Thread(self._run, "services")
            self._thread.start()
        # What a new client has got so far may have been added before.
        os.eventfd_write(self._eventfd, _MOST_WAITING)

    def finish(self, change: Change) -> None:
        """Close the services that only the earlier program had."""
        if change.services is None:
            return
        if change.services.ending:
            self._node.close_services(change.services.ending)
        for unused in change.services.unused:
            unused.close()

    def _end(self, ending: Iterable[ServedService]) -> None:
        """End the open calls, and those that wait for services that end."""
        if self._calls is None or self._asking is None:
            return
        self._calls.end(boottime_ns())
        self._asking.end(boottime_ns())
        for served in ending:
            try:
                for request in served.waiting():
                    self._calls.cancel(served.plan.label, (served, request), boottime_ns())
            except RuntimeError as error:  # of rcl
                logger.warning("calls that waited are lost", service=served.plan.name, problem=str(error))
        self._note_open()

    def _acquire(self) -> None:
        if not self._lock.acquire(timeout=_PATIENCE_S):
            raise StuckError("the thread that serves ROS services is stuck in the middleware")

    # the thread

    def _run(self) -> None:
        poll = select.poll()
        poll.register(self._eventfd, select.POLLIN)
        while not self._is_stopping:
            poll.poll(self._patience())
            arrived = 0
            with suppress(BlockingIOError):
                arrived = os.eventfd_read(self._eventfd)
            with self._lock:
                try:
                    self._serve(arrived)
                except Exception as error:  # noqa: BLE001 a bug is logged; later calls are still served
                    fault(error, "lost a call of a service").log()

    def _patience(self) -> float:
        """Return how long to wait, in ms."""
        due = min(self._calls.due, self._asking.due) if self._calls and self._asking else NEVER
        wait = (due - boottime_ns()) / 1e6 if due != NEVER else _LOOK_S * 1e3
        return max(0.0, min(wait + 1, _LOOK_S * 1e3))

    def _serve(self, arrived: int) -> None:
        """Take and send what has come and is due. `arrived` is what has been added to the eventfd."""
        assert self._calls is not None  # noqa: S101 - the thread runs
        assert self._asking is not None  # noqa: S101 - likewise
        self._sender.look()
        while self._replies:
            reply = self._replies.popleft()
            self._calls.reply(reply.service, reply.message, boottime_ns())
            self._asking.request(reply.service, reply.message, boottime_ns())
        for client in self._calling.values():
            for response in client.take_all(arrived):
                self._asking.response(client.plan.label, response.number, response.message, boottime_ns())
        for served in self._served.values():
            for request in self._turn(served):
                caller = served, request
                self._calls.call(served.plan.label, caller, request.message, request.called_at, boottime_ns())
        self._calls.serve(boottime_ns())
        self._asking.serve(boottime_ns())
        self._note_open()

    def _turn(self, served: ServedService) -> Iterator[Request]:
        """Take the requests that wait, but not too many at once."""
        for _ in range(_TURN):
            if (request := served.take()) is None:
                return
            yield request
        os.eventfd_write(self._eventfd, 1)

    def _note_open(self) -> None:
        if self._calls is None or self._asking is None:
            return
        for name, number in {**self._calls.open_calls(), **self._asking.open_requests()}.items():
            self._counts[self._running.counters[name].open] = number

    # effects of calls

    def send(self, plan: ServicePlan, request: bytes, called_at: int) -> bytes | str:
        return self._sender.send(self._running.routes[plan.label], request, called_at)

    def send_again(self, plan: ServicePlan, datagram: bytes) -> str | None:
        self._counts[self._running.retries[plan.name]] += 1
        return self._sender.send_again(self._running.routes[plan.label], datagram)

    def answer(self, plan: ServicePlan, caller: tuple[ServedService, Request], response: bytes) -> None:
        served, request = caller
        try:
            served.answer(request, response)
        except RuntimeError as error:  # of rcl: the client has gone
            logger.warning("a response could not be sent", service=plan.name, problem=str(error))

    def ended(self, plan: ServicePlan, outcome: str, duration: int) -> None:
        self._count(plan.name, plan.endpoint, outcome, duration)

    def _count(self, name: str, other: str, outcome: str, duration: int) -> None:
        """Count a call, which `other` should have answered."""
        self._running.counters[name].count(self._counts, outcome, duration)
        if is_failure(outcome):
            self._reporter.report(Report("call", name, other, outcome))

    def unmatched(self, plan: ServicePlan, number: int | None) -> None:
        self._counts[self._running.unmatched[plan.name]] += 1
        detail = f"number {number}" if number is not None else ""
        self._reporter.report(Report("reply", plan.name, "", "unmatched", None, detail))

    # effects of requests of endpoints

    def ask(self, plan: CalledPlan, request: bytes) -> int | None:
        try:
            return self._calling[plan.name].ask(request)
        except RuntimeError as error:  # of rcl
            logger.warning("a service could not be called", service=plan.service, problem=str(error))
            return None

    def reply(self, plan: CalledPlan, message: bytes, *, is_response: bool) -> bool:
        route = self._running.routes[plan.label if is_response else plan.failed]
        return not isinstance(self._sender.send(route, message, wall_ns()), str)

    def finished(self, plan: CalledPlan, outcome: str, duration: int) -> None:
        self._count(plan.name, plan.service, outcome, duration)

    # stopping

    def close(self) -> None:
        """End all calls, and close the services."""
        self._is_stopping = True
        os.eventfd_write(self._eventfd, 1)
        if self._thread is not None and not join_or_abandon(self._thread):
            self._topics.leave_open()
            return
        self._end(self._served.values())
        if self._served:
            self._node.close_services(self._served.values())
        for client in self._calling.values():
            client.close()
        self._sender.close()


def _is_other(kept: ServicePlan | CalledPlan | ClientCallPlan, plan: ServicePlan | CalledPlan) -> bool:
    """Return whether ROS needs another service or client."""

    def key(each: ServicePlan | CalledPlan | ClientCallPlan) -> tuple[object, ...]:
        name = each.ros_name if isinstance(each, ServicePlan) else each.service
        return name, each.type_name, each.definitions

    return key(kept) != key(plan)
