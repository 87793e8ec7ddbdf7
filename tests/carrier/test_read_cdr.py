"""What the machine reads of serialized ROS messages, which may be anything."""

from __future__ import annotations

import struct
from ctypes import CDLL
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from tests.carrier.evaluating import (
    CDR_HEADER,
    REAL,
    TEXT,
    C,
    Layout,
    Machine,
    Operation,
    Refusal,
    Section,
    Step,
    integer,
    load,
)

IN_CELLS = C["IN_CELLS"]
SCALARS = {"BOOL": "?", "INT8": "b", "UINT8": "B", "INT16": "h", "UINT16": "H", "INT32": "i", "UINT32": "I",
           "INT64": "q", "UINT64": "Q", "FLOAT32": "f", "FLOAT64": "d"}  # fmt: skip


class Written:
    """A message in CDR, written plainly."""

    def __init__(self) -> None:
        self.body = bytearray()

    def scalar(self, letter: str, value: object) -> Written:
        size = struct.calcsize(letter)
        self.body += bytes(-len(self.body) % size) + struct.pack("<" + letter, value)
        return self

    def text(self, value: bytes) -> Written:
        self.scalar("I", len(value) + 1)
        self.body += value + b"\0"
        return self

    def message(self) -> bytes:
        return CDR_HEADER + bytes(self.body)


def _size(name: str) -> int:
    return struct.calcsize(SCALARS[name])


def _value_of(name: str) -> st.SearchStrategy[Any]:
    if name == "BOOL":
        return st.booleans()
    if name.startswith("FLOAT"):
        return st.floats(width=32 if name == "FLOAT32" else 64, allow_nan=False)
    low = 0 if name.startswith("U") else -(1 << 8 * _size(name) - 1)
    return st.integers(low, low + (1 << 8 * _size(name)) - 1)


def _read(machine: Machine, slot: int, name: str, *code: Operation) -> object:
    made = machine.value(load(slot), *code, of=REAL if name.startswith("FLOAT") else "integer")
    return made % (1 << 64) if name == "UINT64" and isinstance(made, int) else made


@given(st.lists(st.sampled_from([*SCALARS]), min_size=1, max_size=12), st.data())
def test_scalars_are_aligned_to_their_size(evaluating: CDLL, names: list[str], data: st.DataObject) -> None:
    written, values, steps = Written(), [], []
    for slot, name in enumerate(names):
        values.append(data.draw(_value_of(name)))
        written.scalar(SCALARS[name], values[-1])
        read, skipped = Step("READ_SCALAR", slot, type=f"SCALAR_{name}"), Step("READ_SKIP", size=_size(name), count=1)
        steps.append(data.draw(st.sampled_from([read, skipped])))
    machine = Machine(evaluating, Layout((Section(steps),), is_cdr=True))
    message = written.message()
    assert machine.read(message)
    for slot, (name, step) in enumerate(zip(names, steps, strict=True)):
        if step.kind == "READ_SCALAR":
            assert _read(machine, slot, name) == values[slot]
    assert not machine.read(message[:-1])


@given(st.data())
def test_arrays_and_sequences_are_lists_where_they_are(evaluating: CDLL, data: st.DataObject) -> None:
    name = data.draw(st.sampled_from([*SCALARS]))
    values = data.draw(st.lists(_value_of(name), max_size=5))
    is_array = bool(values) and data.draw(st.booleans())
    written, kept = Written().scalar("Q", 7), f"SCALAR_{name}"
    if not is_array:
        written.scalar("I", len(values))
    for value in values:
        written.scalar(SCALARS[name], value)
    written.scalar("B", 9)
    step = Step("READ_ARRAY" if is_array else "READ_SEQUENCE", 1, size=_size(name), count=len(values) * is_array)
    steps = [Step("READ_SCALAR", 0, type="SCALAR_UINT64"), step, Step("READ_SCALAR", 2, type="SCALAR_UINT8")]
    machine = Machine(evaluating, Layout((Section(steps),), is_cdr=True))
    assert machine.read(written.message())
    assert (machine.slot(0), machine.slot(2), machine.value(load(1), Operation("OP_SIZE"))) == (7, 9, len(values))
    for index, value in enumerate(values):
        assert _read(machine, 1, name, Operation("OP_ELEMENT", flag=C[kept], number=index)) == value
    beyond = machine.value(load(1), Operation("OP_ELEMENT", flag=C[kept], number=len(values)))
    assert beyond == Refusal("mapping_error", 1)
    unpacked = machine.value(load(1), Operation("OP_UNPACK", flag=C[kept]), Operation("OP_SIZE"))
    assert unpacked == len(values)
    if name.startswith("FLOAT"):
        return
    total = [integer(0), load(1), Operation("OP_KEEP", 5), Operation("OP_SIZE"), Operation("OP_REPEAT", size=3),
             Operation("OP_NEXT", 5, flag=C[kept]), Operation("OP_ADD"), Operation("OP_AGAIN")]  # fmt: skip
    assert machine.value(*total) == (sum(values) + (1 << 63)) % (1 << 64) - (1 << 63)
    octets = machine.value(load(1), Operation("OP_OCTETS", flag=C[kept]), of=TEXT)
    fits = all(0 <= value <= 255 for value in values)
    assert octets == (bytes(map(int, values)) if fits else Refusal("mapping_error", 1))


@given(st.lists(st.binary(max_size=9), max_size=5), st.booleans())
def test_texts_come_without_their_final_nul(evaluating: CDLL, texts: list[bytes], is_array: bool) -> None:
    assume(texts or not is_array)
    written = Written().text(b"one")
    if not is_array:
        written.scalar("I", len(texts))
    for element in texts:
        written.text(element)
    message = written.text(b"end").message()
    each = Step("READ_EACH", count=len(texts)) if is_array else Step("READ_EACH_SEQUENCE")
    steps = [Step("READ_TEXT", 0), each, Step("READ_TEXTS", 1), Step("READ_AGAIN"), Step("READ_TEXT", 2)]
    machine = Machine(evaluating, Layout((Section(steps),), is_cdr=True))
    assert machine.read(message)
    assert machine.value(load(0), of=TEXT) == b"one"
    assert machine.listed(1, of=TEXT) == texts
    assert machine.value(load(2), of=TEXT) == b"end"
    assert not machine.read(message[:-1])


def test_only_what_uses_a_text_without_its_nul_refuses_it(evaluating: CDLL) -> None:
    each = [Step("READ_EACH", count=2), Step("READ_TEXTS", 2), Step("READ_AGAIN")]
    steps = [Step("READ_TEXT", 0), Step("READ_TEXT", 1), *each]
    machine = Machine(evaluating, Layout((Section(steps),), is_cdr=True))
    message = Written().text(b"").text(b"whole").text(b"a").text(b"b").message()
    assert machine.read(message[:8] + b"x" + message[9:])
    assert machine.value(load(0), Operation("OP_UTF8"), of=TEXT) == Refusal("mapping_error", 1)
    assert machine.value(load(1), Operation("OP_UTF8"), of=TEXT) == b"whole"
    assert machine.read(message[:-1] + b"x")
    first, second = (
        machine.value(load(2), Operation("OP_ELEMENT", flag=C["IN_CELLS"], number=at), Operation("OP_UTF8"), of=TEXT)
        for at in range(2)
    )
    assert (first, second) == (b"a", Refusal("mapping_error", 2))


def test_some_writers_leave_out_the_nul_of_empty_strings(evaluating: CDLL) -> None:
    steps = [Step("READ_TEXT", 0), Step("READ_TEXT"), Step("READ_SCALAR", 1, type="SCALAR_UINT8")]
    machine = Machine(evaluating, Layout((Section(steps),), is_cdr=True))
    assert machine.read(CDR_HEADER + bytes(8) + b"\x05")
    assert machine.value(load(0), of=TEXT) == b""
    assert machine.slot(1) == 5


@given(st.lists(st.tuples(st.integers(0, 255), st.floats(allow_nan=False), st.lists(st.integers(0, 65535), max_size=3)),
                max_size=5), st.integers(0, 255))  # fmt: skip
def test_elements_are_entered_where_they_begin(
    evaluating: CDLL, elements: list[tuple[int, float, list[int]]], last: int
) -> None:
    written = Written().scalar("B", 1).scalar("I", len(elements))
    for number, real, values in elements:
        written.scalar("B", number).scalar("d", real).scalar("I", len(values))
        for value in values:
            written.scalar("H", value)
    message = written.scalar("B", last).message()
    skipped = [Step("READ_SKIP", size=1, count=1), Step("READ_SKIP", size=8, count=1), Step("READ_SEQUENCE", size=2)]
    outer = [Step("READ_SKIP", size=1, count=1), Step("READ_EACH_SEQUENCE", 0), *skipped, Step("READ_AGAIN"),
             Step("READ_SCALAR", 1, type="SCALAR_UINT8")]  # fmt: skip
    inner = [Step("READ_SCALAR", 2, type="SCALAR_UINT8"), Step("READ_SCALAR", 3, type="SCALAR_FLOAT64"),
             Step("READ_SEQUENCE", 4, size=2)]  # fmt: skip
    machine = Machine(evaluating, Layout((Section(outer), Section(inner, first_slot=2, slot_count=3)), is_cdr=True))
    assert machine.read(message)
    assert machine.slot(1) == last
    assert machine.value(load(0), Operation("OP_SIZE")) == len(elements)
    for index, (number, real, values) in enumerate(elements):
        enter = [load(0), Operation("OP_ELEMENT", flag=IN_CELLS, number=index), Operation("OP_ENTER", 1)]
        assert machine.value(*enter, load(2)) == number
        assert machine.value(*enter, load(3), of=REAL) == real
        assert machine.value(*enter, load(4), Operation("OP_SIZE")) == len(values)
        for at, value in enumerate(values):
            element = Operation("OP_ELEMENT", flag=C["SCALAR_UINT16"], number=at)
            assert machine.value(*enter, load(4), element) == value


def test_lists_in_lists_are_stepped_over(evaluating: CDLL) -> None:
    written = Written().scalar("I", 2)
    for texts in ([b"a", b"bcd"], []):
        written.scalar("I", len(texts))
        for text in texts:
            written.text(text)
    message = written.scalar("H", 77).message()
    each, again = Step("READ_EACH_SEQUENCE"), Step("READ_AGAIN")
    steps = [each, each, Step("READ_TEXT"), again, again, Step("READ_SCALAR", 0, type="SCALAR_UINT16")]
    machine = Machine(evaluating, Layout((Section(steps),), is_cdr=True))
    assert machine.read(message)
    assert machine.slot(0) == 77
    assert machine.read(Written().scalar("I", 0).scalar("H", 5).message())
    assert machine.slot(0) == 5


@pytest.mark.parametrize("message", [b"", CDR_HEADER[:3], b"\0\0\0\0\1\0\0\0", b"\0\7\0\0\1\0\0\0"])
def test_other_representations_are_refused(evaluating: CDLL, message: bytes) -> None:
    assert not Machine(evaluating, Layout((Section(()),), is_cdr=True)).read(message)


@pytest.mark.parametrize("count", [5, 0x7FFF_FFFF, 0x8000_0000, 0xFFFF_FFFF])
@pytest.mark.parametrize("size", [1, 2, 4, 8])
def test_a_length_beyond_the_end_is_refused(evaluating: CDLL, count: int, size: int) -> None:
    message = Written().scalar("I", count).message() + bytes(4)
    loop = [Step("READ_EACH_SEQUENCE", 0), Step("READ_SKIP", size=size, count=1), Step("READ_AGAIN")]
    nothing = [Step("READ_EACH_SEQUENCE"), Step("READ_AGAIN")]
    sequence = Step("READ_SEQUENCE", size=size)
    for steps in ([replace(sequence, slot=0)], [sequence], [Step("READ_TEXT", 0)], loop, nothing):
        assert not Machine(evaluating, Layout((Section(steps),), is_cdr=True)).read(message)


def test_a_message_that_ends_in_its_alignment_is_refused(evaluating: CDLL) -> None:
    steps = [Step("READ_SKIP", size=1, count=1), Step("READ_SCALAR", 0, type="SCALAR_FLOAT64")]
    assert not Machine(evaluating, Layout((Section(steps),), is_cdr=True)).read(CDR_HEADER + b"\1")
