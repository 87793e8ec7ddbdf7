"""Tests that are coroutines, each with a new event loop."""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Callable, Coroutine
from typing import Any, ParamSpec

P = ParamSpec("P")

PATIENCE_SECONDS = 20.0


def asynchronous(test: Callable[P, Coroutine[Any, Any, None]]) -> Callable[P, None]:
    """Make pytest run a coroutine; it fails on a timeout."""

    @functools.wraps(test)
    def run(*arguments: P.args, **settings: P.kwargs) -> None:
        asyncio.run(asyncio.wait_for(test(*arguments, **settings), 3 * PATIENCE_SECONDS))

    return run


async def until(condition: Callable[[], object]) -> None:
    """Wait until the condition holds."""
    deadline = asyncio.get_running_loop().time() + PATIENCE_SECONDS
    while not condition():
        assert asyncio.get_running_loop().time() < deadline, "it never happened"
        await asyncio.sleep(0.002)
