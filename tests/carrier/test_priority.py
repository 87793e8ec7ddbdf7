"""Threads that run first: not where somebody has chosen otherwise, and not in the turn after one that they used up."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from time import thread_time_ns

import pytest

from router.declared import Share

TURN = 100_000_000
"""ns"""


def in_a_thread(run: Callable[[], None]) -> None:
    """Run it in a thread of its own, whose policy ends with it."""
    with ThreadPoolExecutor(1) as thread:
        thread.submit(run).result()


def use_the_processor() -> None:
    until = thread_time_ns() + TURN
    while thread_time_ns() < until:
        pass


def test_the_policy_that_somebody_chose_for_the_router_stays(library: ctypes.CDLL) -> None:
    def run() -> None:
        library.run_first.restype = ctypes.c_bool
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        assert not library.run_first()
        assert os.sched_getscheduler(0) == os.SCHED_IDLE

    in_a_thread(run)


def test_one_that_uses_most_of_a_turn_is_not_first_in_the_next(library: ctypes.CDLL) -> None:
    def run() -> None:
        library.run_first.restype = ctypes.c_bool
        if not library.run_first():
            pytest.skip("needs the right to a real-time priority")
        share = Share(may_be_first=True, is_first=True, used=thread_time_ns())
        policies = [os.sched_getscheduler(0)]
        use_the_processor()
        for now in (TURN - 1, TURN, 2 * TURN - 1, 3 * TURN):
            library.share_processor(ctypes.byref(share), ctypes.c_int64(now))
            policies.append(os.sched_getscheduler(0))
        first, usual = os.SCHED_FIFO, os.SCHED_OTHER
        assert policies == [first, first, usual, usual, first]

    in_a_thread(run)


def test_one_that_may_not_be_first_is_left_alone(library: ctypes.CDLL) -> None:
    def run() -> None:
        share = Share()
        for now in (TURN, 3 * TURN):
            library.share_processor(ctypes.byref(share), ctypes.c_int64(now))
        assert os.sched_getscheduler(0) == os.SCHED_OTHER

    in_a_thread(run)


def test_a_thread_that_may_block_is_not_left_with_the_batch_policy(library: ctypes.CDLL) -> None:
    """It comes from a thread of Python that opens ROS, and would have to wait for others."""

    def policy_after(inherited: int) -> int:
        os.sched_setscheduler(0, inherited, os.sched_param(0))
        library.run_soon()
        return os.sched_getscheduler(0)

    def run() -> None:
        assert policy_after(os.SCHED_BATCH) == os.SCHED_OTHER
        assert policy_after(os.SCHED_IDLE) == os.SCHED_IDLE

    in_a_thread(run)
