"""A thread for calls that may take long, or wait for a network for ever: the process can end all the same."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future
from queue import SimpleQueue
from typing import Any, NamedTuple, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


class _Call(NamedTuple):
    done: Future[Any]
    work: Callable[[], Any]

    def run(self) -> None:
        if not self.done.set_running_or_notify_cancel():
            return
        try:
            result = self.work()
        except BaseException as error:  # noqa: BLE001 - whoever waits is told
            self.done.set_exception(error)
        else:
            self.done.set_result(result)


class DaemonThread(Executor):
    """Calls run one after the other. It begins with the first, and ends some time after `shutdown`.

    Python waits at its end for every thread of a ThreadPoolExecutor.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._calls: SimpleQueue[_Call | None] = SimpleQueue()
        self._thread: threading.Thread | None = None
        self._is_shut_down = False
        self._lock = threading.Lock()

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Raises RuntimeError after `shutdown`."""
        done: Future[T] = Future()
        with self._lock:
            if self._is_shut_down:
                raise RuntimeError(f"the thread '{self._name}' takes no more")
            self._calls.put(_Call(done, lambda: fn(*args, **kwargs)))
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
                self._thread.start()
        return done

    def shutdown(self, wait: bool = False, *, cancel_futures: bool = True) -> None:
        """Gives up what has not begun; what has begun ends when it ends, for which it never waits."""
        with self._lock:
            self._is_shut_down = True
            while not self._calls.empty():
                if (call := self._calls.get()) is not None:
                    call.done.cancel()
            self._calls.put(None)

    def _run(self) -> None:
        while (call := self._calls.get()) is not None:
            call.run()
            del call  # it would keep its data and its result until the next one
