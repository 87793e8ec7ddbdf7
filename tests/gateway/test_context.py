"""What is done again and again, or beside other things, and what its faults and its end are."""

from __future__ import annotations

import asyncio
from contextlib import suppress

from router.gateway.context import Tasks
from tests.gateway.asynchronous import asynchronous

PATIENCE_S = 20.0


@asynchronous
async def test_a_fault_is_told_and_the_next_turn_comes() -> None:
    faults: list[Exception] = []
    turns, enough = 0, asyncio.Event()

    async def turn() -> None:
        nonlocal turns
        turns += 1
        if turns == 3:
            enough.set()
        raise RuntimeError(str(turns))

    tasks = Tasks(faults.append)
    tasks.each(0.001, turn)
    await enough.wait()
    await tasks.close()
    assert [str(fault) for fault in faults[:3]] == ["1", "2", "3"]


@asynchronous
async def test_a_fault_of_what_is_run_once_is_told() -> None:
    fault: asyncio.Future[Exception] = asyncio.get_running_loop().create_future()

    async def fails() -> None:
        raise RuntimeError("no")

    tasks = Tasks(fault.set_result)
    tasks.run(fails())
    assert str(await fault) == "no"
    await tasks.attempt(lambda: asyncio.sleep(0))


@asynchronous
async def test_one_that_misses_the_first_call_to_end_is_called_again() -> None:
    ended = False

    async def misses() -> None:
        nonlocal ended
        with suppress(asyncio.CancelledError):
            await asyncio.sleep(PATIENCE_S)
        try:
            await asyncio.sleep(PATIENCE_S)
        finally:
            ended = True

    tasks = Tasks(lambda _: None)
    tasks.run(misses())
    await asyncio.sleep(0)
    await tasks.close()
    assert ended
