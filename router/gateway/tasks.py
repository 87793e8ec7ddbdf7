"""What a gateway does again and again, or beside other things, in its event loop. Knows nothing of what that is."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any

_PATIENCE_S = 0.1


class Tasks:
    """`failed` hears what they raise: a fault of ours, told loudly, which ends no other task."""

    def __init__(self, failed: Callable[[Exception], None]) -> None:
        self._failed = failed
        self._running: set[asyncio.Task[None]] = set()

    def run(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._running.add(task)
        task.add_done_callback(self._done)

    def each(self, period_s: float, work: Callable[[], Awaitable[None]]) -> None:
        """Calls `work` now and then on a grid of `period_s`; what it missed is left out."""
        self.run(self._each(period_s, work))

    async def attempt(self, work: Callable[[], Awaitable[None]]) -> None:
        """Calls `work` once, and waits for its end, whatever that is."""
        try:
            await work()
        except Exception as error:  # noqa: BLE001 what comes next matters as much
            self._failed(error)

    async def close(self) -> None:
        """Ends them all, wherever they are. One that has just got what it waited for may miss the first call to end:
        asyncio.wait_for does until Python 3.12.
        """
        while running := list(self._running):
            for task in running:
                task.cancel()
            await asyncio.wait(running, timeout=_PATIENCE_S)

    async def _each(self, period_s: float, work: Callable[[], Awaitable[None]]) -> None:
        clock = asyncio.get_running_loop().time
        due = clock()
        while True:
            await self.attempt(work)
            due += period_s * max(1, int((clock() - due) / period_s))
            await asyncio.sleep(due - clock())

    def _done(self, task: asyncio.Task[None]) -> None:
        self._running.discard(task)
        if not task.cancelled() and isinstance(error := task.exception(), Exception):
            self._failed(error)
