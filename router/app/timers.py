"""Threads that serve timers: each has one lock for its timers and calls them when they are due."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from router.clock import boottime_ns
from router.engine.timers import P, R, Timer
from router.log import logger
from router.threads import LEAVING_S, Alarm, StuckError, Thread, join_or_leave

_NEVER = 1 << 63
_RETRY = 100_000_000
"""ns after which a timer that has failed is called again."""


class TimerThread:
    """A thread and a lock for several timers, of which one call runs at a time.

    Other threads use a timer through `locked`. What is called under the lock has to be short and must not block: the
    receive thread may wait for the lock.

    `failed` is called with what a timer raises when it is due or ended; the
    others are served all the same, and it is tried again after 100 ms, or when one of them is used.
    """

    def __init__(self, name: str, failed: Callable[[Exception], None]) -> None:
        self._failed = failed
        self._timers: list[Timer] = []
        self._lock = threading.Lock()
        self._alarm = Alarm()
        self._waits_until = 0  # while the thread does not wait
        self._stopping = False
        self._thread = Thread(self._run, name)

    def add(self, timer: Timer) -> None:
        """Serve `timer` from now on. Idempotent; for one thread at a time.

        Without the lock, which a timer that is stuck in the middleware keeps: a reload must not wait for that. The
        thread may go through the list while it grows.
        """
        if timer not in self._timers:
            self._timers.append(timer)

    def locked(self, timer: Timer, call: Callable[P, R], /) -> Callable[P, R]:
        """Add `timer`, and return `call`, which uses it, wrapped in the lock, for other threads."""
        self.add(timer)
        lock, timers = self._lock, self._timers

        def with_lock(*args: P.args, **kwargs: P.kwargs) -> R:
            with lock:
                try:
                    return call(*args, **kwargs)
                finally:
                    for each in timers:  # a timer may pass messages on to another one
                        due = each.next_due
                        if due is not None and due < self._waits_until:
                            self._waits_until = due
                            self._alarm.set_for(due)

        return with_lock

    def start(self) -> None:
        """Start the thread with the scheduling policy of the caller: not to be called in `background_threads()`."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread, and then the timers in reverse order: those added later may pass on to earlier ones.

        A timer that is stuck in the middleware is left with all others of its thread.
        """
        with self._locked_unless_stuck() as is_locked:
            if not is_locked:
                return
            if not self._stopping:
                self._alarm.set_for(0)
            self._stopping, self._waits_until = True, 0
        if self._thread.ident is not None and not join_or_leave(self._thread):
            return
        with self._lock:
            for timer in reversed(self._timers):
                self._end(timer)
        self._alarm.close()

    @contextmanager
    def _locked_unless_stuck(self) -> Iterator[bool]:
        """Hold the lock; what is called under it may be stuck in the middleware: then log that and yield False."""
        if not self._lock.acquire(timeout=LEAVING_S):
            logger.error("a thread is stuck, and is left", thread=self._thread.name)
            yield False
            return
        try:
            yield True
        finally:
            self._lock.release()

    def check(self) -> None:
        """Raise StuckError if a timer is stuck in the middleware: then what is `locked` would wait for it."""
        with self._locked_unless_stuck() as is_locked:
            if not is_locked:
                raise StuckError(f"the timers '{self._thread.name}' are stuck in the middleware: try again")

    def release(self, candidates: Sequence[object]) -> None:
        """End and remove those of its timers that are among the candidates, in reverse order.

        If one is stuck in the middleware, they stay, and end when they are due.
        """
        with self._locked_unless_stuck() as is_locked:
            if not is_locked:
                return
            for timer in [each for each in reversed(self._timers) if any(each is one for one in candidates)]:
                self._timers.remove(timer)
                self._end(timer)

    def _end(self, timer: Timer) -> None:
        try:
            timer.end(boottime_ns())
        except Exception as error:  # noqa: BLE001 the other timers have to be ended as well
            self._failed(error)

    def _run(self) -> None:
        while True:
            with self._lock:
                if self._stopping:
                    return
                # In reverse order, as those added later may pass on to earlier ones.
                self._waits_until = min(map(self._serve, reversed(self._timers)), default=_NEVER)
                self._alarm.set_for(self._waits_until)
            self._alarm.wait()

    def _serve(self, timer: Timer) -> int:
        """Call the timer if it is due. Return the time of its next call."""
        now = boottime_ns()
        earliest = now
        if timer.next_due is not None and timer.next_due <= now:
            try:
                timer.due(now)
            except Exception as error:  # noqa: BLE001 a bug of the router, which is reported, must not stop a deadman
                self._failed(error)
                earliest += _RETRY
        return _NEVER if timer.next_due is None else max(timer.next_due, earliest)


class Timers:
    """The router's timer threads: deadmen, paced and held messages, and open frames.

    Deadmen have a thread of their own. So have those behind gateways, and held messages of topics: they publish, which
    may block in the middleware.
    """

    def __init__(self, failed: Callable[[Exception], None]) -> None:
        names = "deadman", "inbound deadman", "pacing", "holding", "collect"
        self.threads = tuple(TimerThread(name, failed) for name in names)
        """To be stopped in reverse order: open frames first, then messages that wait, deadmen last."""
        self.deadman, self.inbound_deadman, self.pacing, self.holding, self.collecting = self.threads

    def start(self) -> None:
        for thread in self.threads:
            thread.start()

    def release(self, candidates: Sequence[object]) -> None:
        """End those of the candidates that are timers, in the same order."""
        for thread in reversed(self.threads):
            thread.release(candidates)
