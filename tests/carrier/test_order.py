"""What passes `order` is what an oracle lets pass, and a reload does not forget it."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable
from router.library import library
from router.rehearsal.rehearsal import Dropped, Rehearsal, Sent
from tests.compiler.payloads import wire_of
from tests.oracles.order import MOST_SENDERS, Order
from tests.rehearsal.test_tables import TABLES

PATIENCE = 100
ALL_BITS = (1 << 64) - 1


class Native:
    """The state of a route in the carrier."""

    def __init__(self, bits: int) -> None:
        self._state = library().order_state_open()
        self._bits = bits

    def passes(self, sender: tuple[int, int], number: int, now: int) -> bool:
        last = ctypes.c_uint64()
        how = number & ALL_BITS, self._bits, PATIENCE, now, ctypes.byref(last)
        return bool(library().order_passes(self._state, *sender, *how))

    def close(self) -> None:
        library().order_state_close(self._state)


def numbers(bits: int) -> st.SearchStrategy[int]:
    """Numbers that are often near each other, or half of the range apart."""
    half, most = 1 << (bits - 1), (1 << bits) - 1
    near = st.integers(0, 5) | st.integers(half - 2, half + 2) | st.integers(most - 5, most)
    return (near | st.integers(0, most)).map(lambda number: number & most)


SENDERS = st.tuples(st.integers(0, 2), st.integers(0, 2)) | st.tuples(st.integers(0, 100), st.just(7))


@given(st.data(), st.sampled_from([1, 2, 8, 16, 31, 32, 63, 64]))
def test_what_passes_is_what_the_oracle_lets_pass(data: st.DataObject, bits: int) -> None:
    steps = st.tuples(SENDERS, numbers(bits), st.integers(0, 3) | st.integers(PATIENCE - 1, PATIENCE + 1))
    native, oracle, now = Native(bits), Order(bits, PATIENCE), 10**12
    for sender, number, wait in data.draw(st.lists(steps, max_size=60)):
        now += wait
        assert native.passes(sender, number, now) == oracle.passes(sender, number, now)
    native.close()


def test_the_sender_of_which_nothing_passed_for_the_longest_time_is_forgotten_if_there_are_too_many() -> None:
    native = Native(32)
    assert all(native.passes((sender, 1), 5, sender) for sender in range(MOST_SENDERS))
    assert native.passes((0, 1), 6, 70)
    assert native.passes((1000, 1), 5, 71)  # in place of (1, 1)
    assert not any(native.passes((sender, 1), 5, 72) for sender in (0, *range(2, MOST_SENDERS), 1000))
    assert native.passes((1, 1), 5, 73)
    native.close()


TABLE = """
version: 1
envelope: {protos: PROTOS, message: Frame, oneof: payload}
listen: {rover: {address: "127.0.0.1:5000"}}
endpoints: {robot: {address: "127.0.0.2:8", kind: tool}, base: {address: "127.0.0.3:8", kind: tool}}
routes:
  part: {source: robot, destinations: base, order: NUMBER}
"""


def program(folder: Path, number: str) -> CompiledTable:
    table = folder / "table.yaml"
    table.write_text(TABLE.replace("PROTOS", str(TABLES / "beside")).replace("NUMBER", number))
    made = check_table(table, {}).program
    assert made is not None
    return made


@pytest.mark.parametrize(("later", "passes"), [("envelope.place", False), ("envelope.place * 2", True)])
def test_a_reload_forgets_numbers_only_if_they_are_others(tmp_path: Path, later: str, passes: bool) -> None:
    frame: Any = wire_of(TABLES / "beside", "Frame")[1].message_class(place=7)
    frame.part.value = 1
    rehearsal = Rehearsal(program(tmp_path, "envelope.place"))
    rehearsal.datagram("rover", ("127.0.0.2", 8), frame.SerializeToString())
    rehearsal.reload(program(tmp_path, later))
    rehearsal.events.clear()
    rehearsal.datagram("rover", ("127.0.0.2", 8), frame.SerializeToString())
    lost = [(each.reason, each.detail) for each in rehearsal.events if isinstance(each, Dropped)]
    assert lost == [("out_of_order", "7 again")] * (not passes)
    assert any(isinstance(each, Sent) for each in rehearsal.events) == passes
