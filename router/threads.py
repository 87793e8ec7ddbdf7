"""Threads that never delay the end of the process, wake-up events, and a shutdown with timeouts."""

from __future__ import annotations

import os
import select
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from queue import SimpleQueue
from time import monotonic, sleep
from typing import Any, NamedTuple, ParamSpec, TypeVar

from router.log import logger
from router.shortage import NO_THREAD, is_shortage

P = ParamSpec("P")
T = TypeVar("T")

_LONGEST_WAIT_MS = 3_600_000

START_S = 2.0
"""Timeout in seconds for a started thread to begin to run."""

REST_S = 0.1
"""Seconds before a thread retries after a shortage."""

ACCEPTED_AFTER_CLOSING = "Invalid file descriptor: -1"
"""The text of asyncio's ValueError when it retries `accept`, a second after descriptors ran out, on a closed socket."""


class Thread(threading.Thread):
    """A daemon thread. `target` is called again after a shortage (`is_shortage`)."""

    def __init__(self, target: Callable[..., object], name: str, args: tuple[object, ...] = ()) -> None:
        super().__init__(name=name, daemon=True)
        self._call = target
        self._arguments = args
        self._first = threading.Lock()  # acquired by the thread when it runs, or by the starter when it gives up
        self._started: threading.Event = _Started()

    def start(self) -> None:
        """Start the thread. Raises RuntimeError or MemoryError; then the target is not called.

        Python's own `start` waits forever if a lack of memory ends the thread before it signals that it runs.
        """
        try:
            super().start()
        except _NotInTimeError:
            if self._first.acquire(blocking=False):
                raise RuntimeError(NO_THREAD) from None

    def run(self) -> None:
        if not self._first.acquire(blocking=False):
            return
        with suppress(OSError):  # no file descriptor is left, or /proc is read-only
            Path("/proc/thread-self/comm").write_text(self.name[:15])
        while True:
            try:
                self._call(*self._arguments)
            except Exception as error:
                if not is_shortage(error):
                    raise
                sleep(REST_S)
            else:
                return


class _NotInTimeError(Exception):
    pass


class _Started(threading.Event):
    """The event that `threading.Thread.start` waits for, with a timeout."""

    def wait(self, timeout: float | None = None) -> bool:
        if not super().wait(START_S if timeout is None else timeout):
            raise _NotInTimeError
        return True


class WakeEvent:
    """An event with a monotonic timeout, for one waiting thread.

    In a Python built for a glibc older than 2.30, as many portable builds are, `threading.Condition` measures its
    timeout by the wall clock: if that is set back by an hour, the wait lasts an hour longer.
    """

    def __init__(self) -> None:
        self._event = os.fdopen(os.eventfd(0), "r+b", buffering=0)
        self._poll = select.poll()
        self._poll.register(self._event, select.POLLIN)

    def wait(self, nanoseconds: int) -> None:
        """Wait until the event is set, for at most `nanoseconds` or an hour.

        Returns at once if the event was set since the last wait.
        """
        if self._poll.poll(min(max(0, nanoseconds) / 1e6, _LONGEST_WAIT_MS)):
            self._event.read(8)

    def set(self) -> None:
        self._event.write((1).to_bytes(8, sys.byteorder))

    def close(self) -> None:
        """Close the event. Idempotent. Neither `wait` nor `set` may be called afterwards."""
        self._event.close()


@contextmanager
def background_threads() -> Iterator[None]:
    """Keep threads that libraries start in this context from preempting other threads when they wake up.

    They inherit Linux's batch scheduling: the same share of the processor without wake-up preemption. Fast DDS wakes
    one of its threads several times per reliable message; on a processor shared with the receive thread, that caused
    half of all context switches and took about a tenth of the time. A policy other than the default is not changed.
    """
    if os.sched_getscheduler(0) != os.SCHED_OTHER:
        yield
        return
    os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    try:
        yield
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


class _Call(NamedTuple):
    done: Future[Any]
    work: Callable[[], Any]

    def run(self) -> None:
        if not self.done.set_running_or_notify_cancel():
            return
        try:
            result = self.work()
        except BaseException as error:  # noqa: BLE001 - raised by `Future.result`
            self.done.set_exception(error)
        else:
            self.done.set_result(result)


class DaemonThread(Executor):
    """An executor with one daemon thread, for calls that may block forever.

    The interpreter waits at exit for all threads of a ThreadPoolExecutor, but not for this one. The thread starts with
    the first call.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._calls: SimpleQueue[_Call | None] = SimpleQueue()
        self._thread: Thread | None = None
        self._is_shut_down = False
        self._lock = threading.Lock()

    def has_waiting(self) -> bool:
        """Return whether a call waits for an earlier one to end."""
        return not self._is_shut_down and not self._calls.empty()

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Queue a call.

        Raises RuntimeError after `shutdown`, or if the thread cannot be started; the next call tries again.
        """
        done: Future[T] = Future()
        with self._lock:
            if self._is_shut_down:
                raise RuntimeError(f"the thread '{self._name}' was shut down")
            if self._thread is None:
                thread = Thread(self._run, self._name)
                thread.start()
                self._thread = thread
            self._calls.put(_Call(done, lambda: fn(*args, **kwargs)))
        return done

    def shutdown(self, wait: bool = False, *, cancel_futures: bool = True) -> None:
        """Cancel all calls that have not started. Whatever the arguments, never wait for a running call."""
        with self._lock:
            self._is_shut_down = True
            while not self._calls.empty():
                if (call := self._calls.get()) is not None:
                    call.done.cancel()
            self._calls.put(None)

    def _run(self) -> None:
        while (call := self._calls.get()) is not None:
            call.run()
            del call  # else its arguments and result would live until the next call


ABANDON_S = 1.0
"""How long, in seconds, a reload or a stop waits for a thread that may be stuck in the middleware."""


def join_or_abandon(thread: threading.Thread, timeout: float = ABANDON_S) -> bool:
    """Wait for the end of a daemon thread, if it was started. On timeout, log that and return False."""
    if thread.ident is None:  # its start has failed, which the caller of `start` reports
        return True
    thread.join(timeout)
    if thread.is_alive():
        logger.error("thread did not stop in time; continuing", thread=thread.name)
    return not thread.is_alive()


class StopStack(ExitStack):
    """An ExitStack whose callbacks have timeouts: after one, a line is logged and the next callback is called.

    Each callback runs in its own thread; if none can be started, it runs in this one, without a timeout. `outer` is a
    stack with which this one shares the timeout of all steps.
    """

    def __init__(self, outer: StopStack | None = None) -> None:
        super().__init__()
        self._steps: _Steps = outer._steps if outer else _Steps()

    def callback(self, callback: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Callable[P, T]:
        name = getattr(callback, "__qualname__", repr(callback))
        super().callback(self._steps.call_or_abandon, name, lambda: callback(*args, **kwargs))
        return callback


STEP_S, STEPS_S, LEAST_S = 3.0, 6.0, 0.2
"""Timeouts in seconds of a step, of all steps, and of a step after that. systemd kills the router after 10 s."""


class _Steps:
    """The steps of one shutdown, in sequence."""

    def __init__(self) -> None:
        self._until: float | None = None
        self._has_threads = True

    def call_or_abandon(self, name: str, work: Callable[[], object]) -> None:
        if self._until is None:
            self._until = monotonic() + STEPS_S
        call = _Call(Future(), work)
        if (thread := self._started(call, name)) is None:
            call.run()
        else:
            thread.join(max(LEAST_S, min(STEP_S, self._until - monotonic())))
        if call.done.done():
            call.done.result()
        else:
            logger.error("shutdown step did not finish in time; continuing", step=name)

    def _started(self, call: _Call, name: str) -> Thread | None:
        if self._has_threads:
            try:
                thread = Thread(call.run, f"stop: {name}")
                thread.start()
            except (RuntimeError, MemoryError):
                self._has_threads = False
            else:
                return thread
        return None


class StuckError(RuntimeError):
    """A thread did not respond in time; nothing was changed."""
