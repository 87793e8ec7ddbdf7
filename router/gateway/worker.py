"""A thread for what would hold up an event loop. Knows nothing of what that is."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future
from queue import SimpleQueue
from typing import Any, TypeVar

T = TypeVar("T")

_PATIENCE_S = 0.5


class Worker(Executor):
    """One thread, for `loop.run_in_executor`. Unlike those of concurrent.futures, the process does not wait for it."""

    def __init__(self, name: str) -> None:
        self._jobs: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    def submit(self, work: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """What is submitted first is done first. The future may be cancelled until then."""
        future = Future[T]()

        def job() -> None:
            if not future.set_running_or_notify_cancel():
                return
            try:
                future.set_result(work(*args, **kwargs))
            except BaseException as error:  # noqa: BLE001 it is the caller's
                future.set_exception(error)

        self._jobs.put(job)
        return future

    def stop(self) -> None:
        """What is being worked on may go on when this returns, until the process ends; its result is for nobody."""
        self._jobs.put(None)
        self._thread.join(_PATIENCE_S)

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            job()
            del job  # and all that it has hold of
