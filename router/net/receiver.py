"""The receive thread: takes datagrams from all listeners and gives each to whoever it is for, until told to stop.

Where datagrams come thick, it lets some of them gather before it looks again; where they do not, it waits for each.
Between two datagrams it does what others ask for: so what it calls can be replaced while it runs.
"""

from __future__ import annotations

import ctypes
import select
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, wait
from contextlib import suppress
from time import monotonic_ns

from router.net.coalescing import SAMPLE
from router.net.reader import TURN, WAIT, Intake, Receive
from router.net.udp import Listener

_PATIENCE = 0.25
"""Seconds for which it waits for a datagram before it looks whether there is something else to do."""

_MOST_WAITING = 1 << 16
"""Datagrams that are taken from a socket at its end, at most: more than a receive buffer holds."""

_ppoll = ctypes.CDLL(None).ppoll
"""Python's own waits take whole milliseconds, or (select) no descriptor above 1023."""
_ppoll.argtypes = (ctypes.c_void_p, ctypes.c_ulong, ctypes.c_void_p, ctypes.c_void_p)


class ReceiveThread:
    """Calls `receive[listener](data, peer)` for each datagram, on one thread of its own.

    `limit` is the longest datagram in bytes that is received whole. A longer one arrives with its true
    length (MSG_TRUNC), its tail being whatever the memory held: the receiver must refuse it by length.
    `enough` tells how many datagrams of a listener may gather before they are looked at (see `coalescing`).
    What `receive` raises goes to `failed`, and receiving goes on.
    """

    def __init__(
        self,
        listeners: Sequence[Listener],
        receive: Mapping[str, Receive],
        limit: int,
        enough: Callable[[], int],
        failed: Callable[[Exception], None],
    ) -> None:
        self._size = limit + 1
        self._enough = enough
        self._intakes: list[Intake] = []
        self.serve(listeners, receive)
        self._failed = failed
        self._ended = False
        self._turns = 0
        self._tasks: deque[Callable[[], None]] = deque()
        self._first: Callable[[], None] | None = None
        self._thread = threading.Thread(target=self._run, name="receive")

    @property
    def turns(self) -> int:
        """Grows at least every 250 ms, unless datagrams keep the thread busy or it is stuck."""
        return self._turns

    def start(self, first: Callable[[], None] | None = None) -> None:
        """The thread begins with `first`, which may say again what somebody said while the thread did not run yet."""
        self._first = first
        self._thread.start()

    def serve(self, listeners: Sequence[Listener], receive: Mapping[str, Receive]) -> None:
        """From now on these listeners, each by `receive[listener.name]`. For a task only, once it has started."""
        self._listeners = listeners
        self._intakes = [Intake(each, receive[each.name], self._size, self._enough) for each in listeners]

    def give_to(self, receive: Mapping[str, Receive]) -> None:
        """From now on each listener's datagrams go to `receive[listener.name]`. For a task only."""
        for intake in self._intakes:
            intake.receive = receive[intake.listener.name]

    def finish(self, listener: Listener) -> None:
        """Lets nothing new in, and handles what the kernel already holds. For a task, before `serve` without it."""
        listener.end_input()
        [intake] = (each for each in self._intakes if each.listener is listener)
        self._empty(intake)

    def between(self, task: Callable[[], None]) -> None:
        """Has the thread call `task` between two datagrams, and returns when that is done; raises what it raises.

        While the thread does not run, it is called here.
        """
        done: Future[None] = Future()

        def tell() -> None:
            try:
                task()
            except Exception as error:  # noqa: BLE001 raised where it was asked for
                done.set_exception(error)
            else:
                done.set_result(None)

        self._tasks.append(tell)
        while not done.done():
            if not self._thread.is_alive():
                self._do_tasks()
            wait([done], _PATIENCE)
        done.result()

    def _do_tasks(self) -> None:
        with suppress(IndexError):  # another thread may do them as well when this one has ended
            while self._tasks:
                self._tasks.popleft()()

    def stop(self) -> None:
        """Lets nothing new in, handles what the kernel already holds, and returns when that is done.

        What is in a socket that was inherited stays there, for whoever has it next.
        """
        for listener in self._listeners:
            listener.end_input()
        self._tasks.append(self._end)
        self._thread.join()

    def _end(self) -> None:
        for intake in self._intakes:
            if not intake.listener.is_inherited:
                self._empty(intake)
        self._ended = True

    def _empty(self, intake: Intake) -> None:
        for _ in range(_MOST_WAITING):
            try:
                if not intake.take(1):
                    return
            except Exception as error:  # noqa: BLE001 as below
                self._failed(error)

    def _run(self) -> None:
        while not self._ended:
            try:
                if self._first is not None:
                    first, self._first = self._first, None
                    first()
                if len(self._intakes) == 1:
                    self._from_one()
                else:
                    self._from_many()
                self._do_tasks()
            except Exception as error:  # noqa: BLE001 a fault of the router, told loudly, is no reason to stop receiving
                self._failed(error)
        self._do_tasks()

    def _from_one(self) -> None:
        """Until there are tasks. One system call per datagram: a blocking receive is also the wait."""
        [intake] = self._intakes
        receive, receive_from, size, tasks = intake.receive, intake.receive_from, intake.size, self._tasks
        intake.wait_at_most(_PATIENCE)
        while not tasks:
            self._turns += 1
            since = monotonic_ns()
            for _ in range(SAMPLE):
                try:
                    data, peer = receive_from(size, WAIT)
                except BlockingIOError:
                    break
                if peer is None:  # input has ended
                    return
                receive(data, peer)
                if tasks:
                    return
            rest = intake.coalescing.first(monotonic_ns() - since)
            while rest and not tasks:
                self._turns += 1
                time.sleep(rest)
                rest = intake.coalescing.next(intake.take(sys.maxsize))

    def _from_many(self) -> None:
        """The same; few datagrams per listener and turn, so that a flooded one cannot starve the others.

        Those that coalesce are not waited for, but looked at when they have rested.
        """
        with select.epoll() as waiting:
            intakes = {intake.descriptor: intake for intake in self._intakes}
            for descriptor in intakes:
                waiting.register(descriptor, select.EPOLLIN)
            wait_for = _BriefWait(waiting.fileno())
            looks: dict[int, float] = {}  # of those that coalesce: when, by time.monotonic
            while not self._tasks:
                self._turns += 1
                for descriptor in _ready(waiting, looks, wait_for):
                    _, rest = intakes[descriptor].take_one()
                    if rest:
                        waiting.modify(descriptor, 0)
                        looks[descriptor] = time.monotonic() + rest
                for descriptor in _due(looks):
                    taken, rest = intakes[descriptor].take_some()
                    if taken == TURN:
                        continue
                    if rest:
                        looks[descriptor] = time.monotonic() + rest
                    else:
                        waiting.modify(descriptor, select.EPOLLIN)
                        del looks[descriptor]


class _PollFd(ctypes.Structure):
    _fields_ = (("fd", ctypes.c_int), ("events", ctypes.c_short), ("revents", ctypes.c_short))


class _TimeSpec(ctypes.Structure):
    _fields_ = (("sec", ctypes.c_long), ("nsec", ctypes.c_long))


class _BriefWait:
    """Waits until `descriptor` is readable, for less than one second. It may end early. For one thread."""

    def __init__(self, descriptor: int) -> None:
        self._timeout = _TimeSpec()
        self._polled = _PollFd(descriptor, select.POLLIN)
        self._arguments = ctypes.addressof(self._polled), 1, ctypes.addressof(self._timeout), None

    def __call__(self, seconds: float) -> None:
        self._timeout.nsec = int(seconds * 1e9)
        _ppoll(*self._arguments)


def _ready(waiting: select.epoll, looks: Mapping[int, float], wait_for: Callable[[float], None]) -> list[int]:
    """What has something. Waits for that until the next look is due."""
    if not looks:
        return [descriptor for descriptor, _ in waiting.poll(_PATIENCE)]
    if (timeout := min(looks.values()) - time.monotonic()) > 0:
        wait_for(timeout)
    return [descriptor for descriptor, _ in waiting.poll(0) if descriptor not in looks]


def _due(looks: Mapping[int, float]) -> list[int]:
    now = time.monotonic() if looks else 0.0
    return [descriptor for descriptor, at in looks.items() if at <= now]
