"""Which threads may interrupt others."""

from __future__ import annotations

import os
import threading

import pytest

from router.threads.background import background_threads


def policy_of_a_new_thread() -> int:
    policies: list[int] = []
    thread = threading.Thread(target=lambda: policies.append(os.sched_getscheduler(0)))
    thread.start()
    thread.join()
    return policies[0]


def test_threads_started_inside_are_batch_and_those_after_are_not() -> None:
    with background_threads():
        inside = policy_of_a_new_thread()
    assert (inside, policy_of_a_new_thread()) == (os.SCHED_BATCH, os.SCHED_OTHER)


def test_the_policy_returns_after_an_error() -> None:
    with pytest.raises(LookupError), background_threads():
        raise LookupError
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


def test_another_policy_is_left_alone() -> None:
    seen: list[int] = []

    def in_idle_policy() -> None:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        with background_threads():
            seen.append(policy_of_a_new_thread())
        seen.append(os.sched_getscheduler(0))

    thread = threading.Thread(target=in_idle_policy)
    thread.start()
    thread.join()
    assert seen == [os.SCHED_IDLE, os.SCHED_IDLE]
