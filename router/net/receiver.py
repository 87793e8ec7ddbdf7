"""The receive thread: reads datagrams of all listeners and passes each to its receiver.

Where datagrams come densely, the thread lets some of them gather before it reads again, as network cards moderate their
interrupts: waking up costs more than handling a datagram. Between two datagrams it executes tasks of other threads, so
that what it calls can be replaced while it runs.
"""

from __future__ import annotations

import ctypes
import select
import socket
import struct
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, wait
from contextlib import suppress
from time import monotonic_ns

from router.clock import boottime_ns, wall_ns
from router.engine.dispatch import Peer
from router.engine.freshness import Freshness
from router.net.udp import Listener
from router.threads import Thread, join_or_leave

Receive = Callable[[bytes, Peer], object]
"""Takes a datagram. What it returns is of no use here."""

SAMPLE = 32
"""Number of datagrams by which their density is measured."""

FOR_SUBSCRIBERS = 8
"""Datagrams that may gather while a topic has subscribers: ROS queues are commonly ten deep, and a longer burst would
overflow them."""

FOR_SOCKETS = 32
"""Datagrams that may gather if they only go to sockets, whose buffers hold hundreds."""

_DENSE = 3
"""Datagrams in the longest pause, on average, with which pauses begin. With fewer than two in a pause they end."""

_SHORTEST_PAUSE = 150e-6
"""Seconds. A shorter pause costs as much as the wake-ups that it saves."""

_TURN = 4
"""The most datagrams of one of several listeners in a row."""

_WAIT = socket.MSG_TRUNC.value
_DONT_WAIT = _WAIT | socket.MSG_DONTWAIT.value

_TIMEVAL = struct.Struct("@ll")

_TASK_INTERVAL = 0.25
"""Seconds for which the thread waits for a datagram before it looks for tasks."""

_FAULT_PAUSE = 0.001

_MOST_WAITING = 1 << 16
"""The most datagrams that are read when a listener ends: more than a receive buffer holds."""

_EMPTYING_S = 2.5
"""How long the end of the thread may take, with all that is read then."""

_ppoll = ctypes.CDLL(None).ppoll
"""Python's own functions wait for whole milliseconds, or (select) for no descriptor above 1023."""
_ppoll.argtypes = (ctypes.c_void_p, ctypes.c_ulong, ctypes.c_void_p, ctypes.c_void_p)


class Coalescing:
    """The length of the pauses of one listener, in seconds; 0 stands for waiting for each datagram.

    `longest` is the longest pause in ns, 0 for none. `target()` is how many datagrams should gather in a pause.
    """

    def __init__(self, longest: int, target: Callable[[], int]) -> None:
        self._longest = longest / 1e9
        self._target = target
        self._pause = 0.0

    def first(self, elapsed: int) -> float:
        """The pause after SAMPLE datagrams that were waited for and came in `elapsed` ns."""
        self._pause = elapsed / 1e9
        return self.next(SAMPLE) if self._pause * _DENSE < self._longest * SAMPLE else 0.0

    def next(self, taken: int) -> float:
        """The pause after one in which `taken` datagrams came."""
        if taken < 2:
            return 0.0
        self._pause = min(self._longest, self._pause * self._target() / taken)
        return self._pause if self._pause >= min(self._longest, _SHORTEST_PAUSE) else 0.0


class _Reader:
    """Reads one listener's datagrams, each up to `size` bytes. `target` is as in `Coalescing`."""

    def __init__(self, listener: Listener, receive: Receive, size: int, target: Callable[[], int]) -> None:
        self.listener = listener
        self.descriptor = listener.socket.fileno()
        self._socket = listener.socket
        self.receive_from = listener.socket.recvfrom
        self.receive = receive
        self.size = size
        self.coalescing = Coalescing(listener.coalesce, target)
        self._taken = 0  # since the clock was read, or since the last pause
        self._since = 0

    def wait_at_most(self, seconds: float) -> None:
        """Make a blocking receive raise BlockingIOError after that; Python's own timeout would cost a call of poll."""
        timeout = _TIMEVAL.pack(int(seconds), int(seconds % 1 * 1e6))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, timeout)

    def pass_on_error(self) -> None:
        """Handle what a receive has raised. Errors about what was sent from the listener's port go to the senders."""
        if not self.listener.note_errors():
            time.sleep(_FAULT_PAUSE)  # the error is another one, and may come again

    def take(self, most: int) -> int:
        """Read what has arrived, and return how many datagrams: fewer than `most` if there are no more."""
        receive, receive_from, size, flags = self.receive, self.receive_from, self.size, _DONT_WAIT
        for taken in range(most):
            try:
                data, peer = receive_from(size, flags)
            except BlockingIOError:  # also for a datagram with a wrong checksum
                return taken
            except OSError:
                self.pass_on_error()
                continue
            receive(data, peer)
        return most

    def take_ready(self) -> float:
        """Read one datagram of a listener that was waited for. Return the pause that follows, in seconds."""
        pause = 0.0
        self._taken += self.take(1)
        if self._taken == SAMPLE:
            now = monotonic_ns()
            pause = self.coalescing.first(now - self._since)
            self._taken, self._since = 0, now
        return pause

    def take_gathered(self) -> float | None:
        """Read up to _TURN datagrams after a pause. Return the next pause, or None if there may be more to read."""
        taken = self.take(_TURN)
        self._taken += taken
        if taken == _TURN:
            return None
        pause = self.coalescing.next(self._taken)
        self._taken, self._since = 0, monotonic_ns()
        return pause


class ReceiveThread:
    """Calls the receivers that `serve` sets for each datagram, in a thread of its own.

    `limit` is the longest datagram in bytes that is received whole. A longer one has its true length (MSG_TRUNC) with
    arbitrary bytes at the end: the receiver must reject it by its length. `coalescing_target()` is how many datagrams
    of a listener may gather before they are read. `failed` is called with what a receiver raises. `freshness` is that
    of the datagrams.
    """

    def __init__(self, limit: int, coalescing_target: Callable[[], int], failed: Callable[[Exception], None]) -> None:
        self._size = limit + 1
        self._coalescing_target = coalescing_target
        self._listeners: Sequence[Listener] = ()
        self._readers: list[_Reader] = []
        self._failed = failed
        self.freshness = Freshness()
        self._ended = False
        self._turns = 0
        self._tasks: deque[Callable[[], None]] = deque()
        self._first: Callable[[], None] | None = None
        self._thread = Thread(self._run, "receive")

    @property
    def turns(self) -> int:
        """A number that grows at least every 250 ms, unless datagrams keep the thread busy or it is stuck."""
        return self._turns

    def start(self, first: Callable[[], None] | None = None) -> None:
        """Start the thread, which calls `first` before it receives."""
        self._first = first
        self._thread.start()

    def serve(self, listeners: Sequence[Listener], receive: Mapping[str, Receive]) -> None:
        """Replace the listeners, and their receivers by name. Once the thread runs, to be called by a task only."""
        self._listeners = listeners
        self._readers = [_Reader(each, receive[each.name], self._size, self._coalescing_target) for each in listeners]

    def replace_receivers(self, receive: Mapping[str, Receive]) -> None:
        """Replace the receivers, by name of listener. To be called by a task only."""
        for reader in self._readers:
            reader.receive = receive[reader.listener.name]

    def finish(self, listener: Listener) -> None:
        """End a listener's input and handle what the kernel holds. For a task, before `serve` without the listener."""
        listener.end_input()
        [reader] = (each for each in self._readers if each.listener is listener)
        self._empty(reader)

    def call_between(self, task: Callable[[], None]) -> None:
        """Have the thread call `task` between two datagrams; return when that is done, and raise what it raises.

        If the thread does not run, `task` is called here.
        """
        done: Future[None] = Future()

        def call() -> None:
            try:
                task()
            except Exception as error:  # noqa: BLE001 raised by `done.result`
                done.set_exception(error)
            else:
                done.set_result(None)

        self._tasks.append(call)
        while not done.done():
            if not self._thread.is_alive():
                self._do_tasks()
            wait([done], _TASK_INTERVAL)
        done.result()

    def _do_tasks(self) -> None:
        with suppress(IndexError):  # several threads may do this once the receive thread has ended
            while self._tasks:
                self._tasks.popleft()()

    def stop(self) -> None:
        """End all input, handle what the kernel holds, and wait for the end of the thread.

        What is in an inherited socket stays there, for the next process.
        """
        for listener in self._listeners:
            listener.end_input()
        self._tasks.append(self._end)
        join_or_leave(self._thread, _EMPTYING_S)

    def _end(self) -> None:
        for reader in self._readers:
            if not reader.listener.is_inherited:
                self._empty(reader)
        self._ended = True

    def _empty(self, reader: _Reader) -> None:
        for _ in range(_MOST_WAITING):
            try:
                if not reader.take(1):
                    return
            except Exception as error:  # noqa: BLE001 as in `_run`
                self._failed(error)

    def _run(self) -> None:
        while not self._ended:
            try:
                if self._first is not None:
                    first, self._first = self._first, None
                    first()
                if len(self._readers) == 1:
                    self._from_one()
                else:
                    self._from_many()
                self._do_tasks()
            except Exception as error:  # noqa: BLE001 a bug of the router is reported, and receiving goes on
                self._failed(error)
        self._do_tasks()

    def _from_one(self) -> None:
        """Serve a single listener until there are tasks, with one system call per datagram: a receive that blocks."""
        [reader] = self._readers
        past = self.freshness.past
        receive, receive_from, size, tasks = reader.receive, reader.receive_from, reader.size, self._tasks
        reader.wait_at_most(_TASK_INTERVAL)
        while not tasks:
            self._turns += 1
            since = monotonic_ns()
            for _ in range(SAMPLE):
                try:
                    data, peer = receive_from(size, _DONT_WAIT if past else _WAIT)
                except BlockingIOError:
                    self._found_empty()
                    break
                except OSError:
                    reader.pass_on_error()
                    break
                if peer is None:  # input has ended
                    return
                receive(data, peer)
                if tasks:
                    return
            pause = reader.coalescing.first(monotonic_ns() - since)
            while pause and not tasks:
                self._turns += 1
                time.sleep(pause)
                pause = reader.coalescing.next(reader.take(sys.maxsize))

    def _from_many(self) -> None:
        """Serve several listeners until there are tasks, with few datagrams per turn, so that none starves the others.

        Listeners that pause are not waited for, but read when their pause is over.
        """
        with select.epoll() as waiting:
            readers = {reader.descriptor: reader for reader in self._readers}
            for descriptor in readers:
                waiting.register(descriptor, select.EPOLLIN)
            wait_for = _BriefWait(waiting.fileno())
            pauses: dict[int, float] = {}  # by descriptor, when each ends by time.monotonic
            while not self._tasks:
                self._turns += 1
                ready = _ready(waiting, pauses, wait_for, 0 if self.freshness.past else _TASK_INTERVAL)
                if not ready and not pauses:
                    self._found_empty()
                for descriptor in ready:
                    if pause := readers[descriptor].take_ready():
                        waiting.modify(descriptor, 0)
                        pauses[descriptor] = time.monotonic() + pause
                for descriptor in _due(pauses):
                    if (next_pause := readers[descriptor].take_gathered()) is None:
                        continue
                    if next_pause:
                        pauses[descriptor] = time.monotonic() + next_pause
                    else:
                        waiting.modify(descriptor, select.EPOLLIN)
                        del pauses[descriptor]

    def _found_empty(self) -> None:
        """What is still to come was not stamped under a setting of the clock that has passed."""
        self.freshness.forget_past()
        now = boottime_ns()
        self.freshness.look(wall_ns(), now)


class _PollFd(ctypes.Structure):
    _fields_ = (("fd", ctypes.c_int), ("events", ctypes.c_short), ("revents", ctypes.c_short))


class _TimeSpec(ctypes.Structure):
    _fields_ = (("sec", ctypes.c_long), ("nsec", ctypes.c_long))


class _BriefWait:
    """Waits less than one second until `descriptor` is readable. May return early. For one thread."""

    def __init__(self, descriptor: int) -> None:
        self._timeout = _TimeSpec()
        self._polled = _PollFd(descriptor, select.POLLIN)
        self._arguments = ctypes.addressof(self._polled), 1, ctypes.addressof(self._timeout), None

    def __call__(self, seconds: float) -> None:
        self._timeout.nsec = int(seconds * 1e9)
        _ppoll(*self._arguments)


def _ready(
    waiting: select.epoll, pauses: Mapping[int, float], wait_for: Callable[[float], None], most: float
) -> list[int]:
    """Wait until the next pause ends, or `most` s; return the descriptors with datagrams that do not pause."""
    if not pauses:
        return [descriptor for descriptor, _ in waiting.poll(most)]
    if (timeout := min(pauses.values()) - time.monotonic()) > 0:
        wait_for(timeout)
    return [descriptor for descriptor, _ in waiting.poll(0) if descriptor not in pauses]


def _due(pauses: Mapping[int, float]) -> list[int]:
    now = time.monotonic() if pauses else 0.0
    return [descriptor for descriptor, at in pauses.items() if at <= now]
