"""What the machine reads of protobuf messages, against the protobuf library."""

from __future__ import annotations

import random
from ctypes import CDLL
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from router.types.wire import delimited, varint
from tests.carrier.evaluating import TEXT, C, Layout, Machine, Operation, Section, WantedField, load
from tests.carrier.messages import some_payloads
from tests.compiler.payloads import wire_of
from tests.envelopes import VARINT, tag

CLOSED = (-1, 0, 1, 2)
_HARD = wire_of(Path(__file__).parent / "protos", "PBEnvelope")[1]
OLD = _HARD.cases["old"]

NEEDED, IS_CLOSED, CLOSED_THERE, SOME, PACKED, TEXTS, EXPANDED, ONE_CLOSED, ONE_NUMBER, INNER, INNER_TEXT, ONE = range(
    12
)
_OF_ONE = {"choice": ONE, "cleared": (ONE_CLOSED, INNER_TEXT - ONE_CLOSED + 1)}
_OLD = Layout(
    sections=(
        Section((
            WantedField(1, "TYPE_INT32", NEEDED),
            WantedField(4, "TYPE_CLOSED_ENUM", IS_CLOSED, presence=CLOSED_THERE, closed=0),
            WantedField(5, "TYPE_CLOSED_ENUM", SOME, is_repeated=True, closed=0),
            WantedField(6, "TYPE_CLOSED_ENUM", PACKED, is_repeated=True, closed=0),
            WantedField(8, "TYPE_BYTES", TEXTS, is_repeated=True),
            WantedField(12, "TYPE_INT32", EXPANDED, is_repeated=True),
            WantedField(14, "TYPE_CLOSED_ENUM", ONE_CLOSED, closed=0, **_OF_ONE),  # type: ignore[arg-type]
            WantedField(15, "TYPE_INT32", ONE_NUMBER, **_OF_ONE),  # type: ignore[arg-type]
            WantedField(16, "TYPE_MESSAGE", section=1, **_OF_ONE),  # type: ignore[arg-type]
        )),
        Section((WantedField(1, "TYPE_INT32", INNER), WantedField(2, "TYPE_BYTES", INNER_TEXT))),
    ),
    closed=(CLOSED,),
)  # fmt: skip
_NUMBERS = {"one_closed": 14, "one_number": 15, "one_message": 16, None: 0}


def _signed(bits: int) -> int:
    return bits - (1 << 64) if bits >> 63 else bits


def _encoded(text: str | bytes) -> bytes:
    """Old syntax lets any bytes be text: upb gives them as they are."""
    return text if isinstance(text, bytes) else text.encode()


@pytest.fixture(scope="module")
def machine(evaluating: CDLL) -> Machine:
    return Machine(evaluating, _OLD)


def _assert_read(machine: Machine, payload: bytes) -> None:
    parsed: Any = OLD.message_class()
    parsed.MergeFromString(payload)
    assert machine.read(payload)
    slots = [_signed(machine.slot(index)) for index in range(12)]
    assert slots[NEEDED] == parsed.needed
    assert (slots[IS_CLOSED], slots[CLOSED_THERE]) == (parsed.closed, parsed.HasField("closed"))
    assert machine.listed(SOME) == list(parsed.some)
    assert machine.listed(PACKED) == list(parsed.packed)
    assert machine.listed(TEXTS, of=TEXT) == [*map(_encoded, parsed.texts)]
    assert machine.listed(EXPANDED) == list(parsed.expanded)
    assert slots[ONE] == _NUMBERS[parsed.WhichOneof("one")]
    assert (slots[ONE_CLOSED], slots[ONE_NUMBER], slots[INNER]) == (
        parsed.one_closed, parsed.one_number, parsed.one_message.needed
    )  # fmt: skip
    assert machine.value(load(INNER_TEXT), of=TEXT) == _encoded(parsed.one_message.text)


def _enums(*numbers: int, alone: int = 0) -> bytes:
    encoded = [varint(number % (1 << 64)) for number in numbers]
    if alone:
        return b"".join(tag(alone, VARINT) + each for each in encoded)
    return b"".join(encoded)


@given(st.integers(0, 1 << 64), st.randoms())
def test_fields_are_those_that_the_library_parses(machine: Machine, seed: int, noise: random.Random) -> None:
    payloads = some_payloads(OLD, seed)
    for payload in payloads:
        _assert_read(machine, payload + noise.choice(payloads))


@given(st.lists(st.tuples(st.sampled_from([4, 5, 6, 14, 15]), st.booleans(), st.lists(st.sampled_from(
    [0, 1, 2, -1, 3, -2, (1 << 32) + 1, (1 << 32) - 1, (1 << 32) + 9, 1 << 63]), max_size=3)), max_size=6))  # fmt: skip
@example([(14, False, [1]), (15, False, [5]), (14, False, [3])])
@example([(5, True, [1, 3, 2]), (5, False, [3]), (6, False, [1]), (6, True, [9, -1])])
def test_numbers_that_a_closed_enum_does_not_have_are_unknown_fields(
    machine: Machine, parts: list[tuple[int, bool, list[int]]]
) -> None:
    payload = b""
    for number, is_packed, numbers in parts:
        payload += delimited(number, _enums(*numbers)) if is_packed else _enums(*numbers, alone=number)
    _assert_read(machine, payload)


def test_messages_in_parts_are_merged_and_cleared(machine: Machine) -> None:
    first, second = delimited(16, b"\x08\x05"), delimited(16, delimited(2, b"text"))
    number, unknown = tag(15, VARINT) + b"\x01", tag(14, VARINT) + b"\x07"
    for payload in (first + second, first + number + second, first + unknown + second, second + number):
        _assert_read(machine, payload)


@pytest.mark.parametrize(
    "payload", [b"\x08", b"\x42\x05ab", b"\x0b\x08", b"\x32\x02\x80\x80", b"\x06", b"\x00\x00\x00"]
)
def test_what_is_cut_is_refused(machine: Machine, payload: bytes) -> None:
    assert not machine.read(b"\x08\x01" + payload) or payload == b"\x00\x00\x00"


def test_a_message_has_the_cells_of_the_one_before(machine: Machine) -> None:
    payload = _enums(*[1] * 300, alone=5)
    assert machine.read(payload)
    before = machine.slot(SOME)  # which cells the list has
    assert machine.read(payload)
    assert machine.slot(SOME) == before


def test_elements_of_lists_are_entered_with_their_own_defaults(evaluating: CDLL) -> None:
    points, x, is_x, numbers = 0, 1, 2, 3
    fields = WantedField(1, "TYPE_SINT32", x, presence=is_x), WantedField(2, "TYPE_FIXED32", numbers, is_repeated=True)
    inner = Section(fields, first_slot=x, slot_count=3)
    section = Section((WantedField(7, "TYPE_MESSAGE", points, is_repeated=True),))
    machine = Machine(evaluating, Layout(sections=(section, inner), defaults={x: 42}))
    elements = [b"\x08\x03", b"", delimited(2, bytes([1, 0, 0, 0, 2, 0, 0, 0])) + b"\x15\x03\0\0\0"]
    assert machine.read(b"".join(delimited(7, each) for each in elements))

    def element(index: int, slot: int, *more: Operation) -> object:
        enter = [Operation("OP_ELEMENT", flag=C["IN_CELLS"], number=index), Operation("OP_ENTER", 1)]
        return machine.value(load(points), *enter, load(slot), *more)

    assert [element(index, x) for index in range(3)] == [-2, 42, 42]
    assert [element(index, is_x) for index in range(3)] == [1, 0, 0]
    assert [element(index, numbers, Operation("OP_SIZE")) for index in range(3)] == [0, 0, 3]
