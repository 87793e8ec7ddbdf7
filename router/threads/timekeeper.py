"""A thread that serves machines: does what is due when it is due. Knows nothing of what they do."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

from router.engine.machine import Machine, P, R
from router.threads.alarm import Alarm

_NEVER = 1 << 63
_RETRY = 100_000_000
"""ns from a machine's failure until it is called again, lest a fault that stays keeps a processor busy."""


class Timekeeper:
    """One thread and one lock for several machines, so that each hears of one thing at a time.

    Who else uses a machine does it through `guard`. What is called under the lock must be short and must
    not wait: another thread may be waiting for the lock to receive a message.

    `clock_ns` is a monotonic clock in ns. What a machine raises when it is due or ended goes to `failed`; the
    others are served all the same, and it is tried again after 100 ms, or when one of them is used.
    """

    def __init__(self, name: str, clock_ns: Callable[[], int], failed: Callable[[Exception], None]) -> None:
        self._clock_ns = clock_ns
        self._failed = failed
        self._machines: list[Machine] = []
        self._lock = threading.Lock()
        self._alarm = Alarm()
        self._waits_until = 0  # while nobody waits
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=name)

    def add(self, machine: Machine) -> None:
        """Has the thread serve `machine`; adding it again changes nothing."""
        with self._lock:
            if machine not in self._machines:
                self._machines.append(machine)

    def guard(self, machine: Machine, call: Callable[P, R], /) -> Callable[P, R]:
        """Adds `machine`, and returns `call`, which uses it, as other threads may call it."""
        self.add(machine)
        lock, machines = self._lock, self._machines

        def guarded(*args: P.args, **kwargs: P.kwargs) -> R:
            with lock:
                try:
                    return call(*args, **kwargs)
                finally:
                    for each in machines:  # a machine may hand on to another one
                        due = each.next_due
                        if due is not None and due < self._waits_until:
                            self._waits_until = due
                            self._alarm.ring()

        return guarded

    def start(self) -> None:
        """The thread is scheduled as the one that calls this: not to be called within `background_threads()`."""
        self._thread.start()

    def stop(self) -> None:
        """Ends the thread, and then the machines: those first that were added last and may hand on to earlier ones."""
        with self._lock:
            if not self._stopping:
                self._alarm.ring()
            self._stopping, self._waits_until = True, 0
        if self._thread.ident is not None:  # it was started
            self._thread.join()
        with self._lock:
            for machine in reversed(self._machines):
                self._end(machine)
        self._alarm.close()

    def release(self, machines: Sequence[object]) -> None:
        """Ends those of its machines that are among these, in the same order, and serves them no more."""
        with self._lock:
            for machine in [each for each in reversed(self._machines) if any(each is one for one in machines)]:
                self._machines.remove(machine)
                self._end(machine)

    def _end(self, machine: Machine) -> None:
        try:
            machine.end(self._clock_ns())
        except Exception as error:  # noqa: BLE001 nor may it keep another deadman from its last word
            self._failed(error)

    def _run(self) -> None:
        while True:
            with self._lock:
                if self._stopping:
                    return
                # The last that was added first: it may hand on to earlier ones.
                self._waits_until = min(map(self._serve, reversed(self._machines)), default=_NEVER)
            self._alarm.wait(self._waits_until - self._clock_ns())

    def _serve(self, machine: Machine) -> int:
        """Calls the machine if it is due. Returns when to look at it again."""
        now = self._clock_ns()
        earliest = now
        if machine.next_due is not None and machine.next_due <= now:
            try:
                machine.due(now)
            except Exception as error:  # noqa: BLE001 a fault of the router, told loudly, must not stop a deadman
                self._failed(error)
                earliest += _RETRY
        return _NEVER if machine.next_due is None else max(machine.next_due, earliest)
