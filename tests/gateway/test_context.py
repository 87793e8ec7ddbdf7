"""What is done again and again, or beside other things, and what its faults and its end are."""

from __future__ import annotations

import asyncio
import itertools
from contextlib import suppress

from router.gateway.context import Tasks
from tests.gateway.asynchronous import PATIENCE_SECONDS, asynchronous, until


@asynchronous
async def test_a_fault_is_told_and_the_next_turn_comes() -> None:
    faults: list[str] = []
    turns = itertools.count()

    async def turn() -> None:
        raise RuntimeError(f"turn {next(turns)}")

    async def other() -> None:
        raise RuntimeError("other")

    tasks = Tasks(lambda fault: faults.append(str(fault)))
    tasks.every(0.001, turn)
    tasks.run(other())
    await until(lambda: len(faults) > 3)
    await tasks.close()
    faults.remove("other")
    assert faults == [f"turn {number}" for number in range(len(faults))]


@asynchronous
async def test_one_that_misses_the_first_call_to_end_is_called_again() -> None:
    ended = False

    async def misses() -> None:
        nonlocal ended
        with suppress(asyncio.CancelledError):
            await asyncio.sleep(PATIENCE_SECONDS)
        try:
            await asyncio.sleep(PATIENCE_SECONDS)
        finally:
            ended = True

    tasks = Tasks(lambda _: None)
    tasks.run(misses())
    await asyncio.sleep(0)
    await tasks.close()
    assert ended
