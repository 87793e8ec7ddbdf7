"""The context that all gateways of a router share, and the tasks of one gateway."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

from router.gateway.subscriptions import Subscriptions

_CANCEL_AGAIN_S = 0.1


@dataclass(frozen=True, slots=True)
class GatewayContext:
    """`converting` converts large messages from ROS, which would block the loop.

    `failed` reports faults of the router itself, `publish_newest` publishes what topics were asked for. Clocks in ns.
    """

    subscriptions: Subscriptions
    converting: Executor
    failed: Callable[[Exception], None]
    publish_newest: Callable[[], None]
    clock_ns: Callable[[], int]
    wall_ns: Callable[[], int]

    def wall_s(self) -> float:
        return self.wall_ns() * 1e-9


class Tasks:
    """Asyncio tasks, periodic or not. Their exceptions go to `failed`; one that fails ends no other task."""

    def __init__(self, failed: Callable[[Exception], None]) -> None:
        self._failed = failed
        self._running: set[asyncio.Task[None]] = set()

    def run(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._running.add(task)
        task.add_done_callback(self._done)

    def every(self, period_s: float, work: Callable[[], Awaitable[None]]) -> None:
        """Call `work` now and then every `period_s`, on a fixed grid; missed points are skipped."""
        self.run(self._every(period_s, work))

    async def attempt(self, work: Callable[[], Awaitable[None]]) -> None:
        """Call `work` once, and report its exceptions."""
        try:
            await work()
        except Exception as error:  # noqa: BLE001 other work continues
            self._failed(error)

    async def close(self) -> None:
        """Cancel all tasks, repeatedly: until Python 3.12, asyncio.wait_for may swallow a cancellation."""
        while running := list(self._running):
            for task in running:
                task.cancel()
            await asyncio.wait(running, timeout=_CANCEL_AGAIN_S)

    async def _every(self, period_s: float, work: Callable[[], Awaitable[None]]) -> None:
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
