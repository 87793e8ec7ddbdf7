"""A ring drops its oldest record when it is full, and each record is either dropped or taken."""

from __future__ import annotations

import ctypes
import os
import threading
from collections import deque
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.carrier.building import MEMORY, RACES, run_program
from tests.readable import readable

CAPACITY = 256
LONGEST = 88


def record(number: int, words: int) -> bytes:
    return (8 * words).to_bytes(4, "little") + number.to_bytes(4, "little") + bytes([number % 256]) * 8 * (words - 1)


class Model:
    """A ring, and what is in it."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._library = library
        self.address = library.ring_open(CAPACITY)
        self._held: deque[bytes] = deque()
        self._numbers = 0

    def put(self, words: int) -> None:
        made = record(self._numbers, words)
        has_room = sum(map(len, self._held)) + len(made) <= CAPACITY
        assert self._library.ring_put(self.address, made, len(made)) == has_room
        if has_room:
            self._held.append(made)
            self._numbers += 1

    def drop(self, limit: int) -> None:
        oldest = ctypes.create_string_buffer(b"\xee" * 8 * 12, 8 * 12)
        has_any = bool(self._held)
        assert self._library.ring_drop(self.address, oldest, 8 * limit) == has_any
        expected = self._held.popleft()[: 8 * limit] if has_any else b""
        assert oldest.raw == expected.ljust(8 * 12, b"\xee")

    def take(self, words: int) -> None:
        records = ctypes.create_string_buffer(8 * 40)
        size = self._library.ring_take(self.address, records, 8 * words, 0)
        expected = b""
        while self._held and len(expected) + len(self._held[0]) <= 8 * words:
            expected += self._held.popleft()
        assert records.raw[:size] == expected


steps = st.one_of(
    st.tuples(st.just("put"), st.integers(1, LONGEST // 8)),
    st.tuples(st.just("put"), st.integers(1, LONGEST // 8)),
    st.tuples(st.just("drop"), st.integers(1, 12)),
    st.tuples(st.just("take"), st.integers(LONGEST // 8, 40)),
)


@given(steps=st.lists(steps, max_size=100))
def test_it_is_a_queue_that_can_lose_its_oldest(library: ctypes.CDLL, steps: list[tuple[str, int]]) -> None:
    model = Model(library)
    try:
        for what, words in steps:
            getattr(model, what)(words)
    finally:
        library.ring_close(model.address)


@pytest.mark.parametrize("capacity", [512, 1 << 16])
@pytest.mark.parametrize(
    "sanitizers",
    [
        "",
        pytest.param(RACES, marks=pytest.mark.slow),
        pytest.param(MEMORY, marks=pytest.mark.slow),
    ],
)
def test_each_record_is_taken_or_dropped(tmp_path: Path, sanitizers: str, capacity: int) -> None:
    run_program("queue", tmp_path, 200_000 if sanitizers else 300_000, capacity, sanitizers=sanitizers)


@pytest.mark.parametrize("which", [1, 2, 3])
@pytest.mark.parametrize("sanitizers", ["", pytest.param(RACES, marks=pytest.mark.slow)])
def test_nothing_that_wakes_a_reader_is_lost(tmp_path: Path, sanitizers: str, which: int) -> None:
    run_program("wakes", tmp_path, 50_000, which, sanitizers=sanitizers)


@pytest.fixture
def ring(library: ctypes.CDLL) -> int:
    return int(library.ring_open(CAPACITY))


def test_a_reader_that_waits_is_woken_by_a_record_or_by_request(library: ctypes.CDLL, ring: int) -> None:
    taken: list[bytes] = []
    ready = threading.Semaphore(0)

    def read() -> None:
        records = ctypes.create_string_buffer(CAPACITY)
        for _ in range(2):
            ready.release()
            size = library.ring_take(ring, records, CAPACITY, -1)
            taken.append(records.raw[:size])

    thread = threading.Thread(target=read)
    thread.start()
    ready.acquire()
    library.ring_put(ring, record(7, 2), 16)
    ready.acquire()
    library.ring_wake(ring)
    thread.join()
    assert taken == [record(7, 2), b""]


def test_who_watches_a_ring_hears_of_each_record(library: ctypes.CDLL, ring: int) -> None:
    wake = library.ring_watch(ring)
    records = ctypes.create_string_buffer(CAPACITY)
    assert not readable(wake)
    for number in range(3):
        library.ring_put(ring, record(number, 2), 16)
        assert readable(wake)
        os.eventfd_read(wake)
        assert library.ring_take(ring, records, CAPACITY, 0) == 16
    assert not readable(wake)


def test_nothing_within_the_timeout(library: ctypes.CDLL, ring: int) -> None:
    assert library.ring_take(ring, ctypes.create_string_buffer(CAPACITY), CAPACITY, 1) == 0
