"""The messages that the machine writes: in CDR, and in protobuf as its library does."""

from __future__ import annotations

import struct
from ctypes import CDLL
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from router.types.wire import delimited, varint
from tests.carrier.evaluating import CDR_HEADER, Machine, Operation, Refusal, integer, load, real, text
from tests.compiler.payloads import wire_of
from tests.envelopes import I32, I64, LEN, VARINT

_HARD = wire_of(Path(__file__).parent / "protos", "PBEnvelope")[1]
HEADER = Operation("OP_KNOWN", 1, data=CDR_HEADER)


@pytest.fixture(scope="module")
def machine(evaluating: CDLL) -> Machine:
    made = Machine(evaluating)
    made.read(b"")
    return made


# ---- CDR


@given(st.lists(st.tuples(st.sampled_from("bHIqfd"), st.integers(0, 127)), max_size=12))
def test_scalars_in_cdr_are_aligned_behind_the_header(machine: Machine, values: list[tuple[str, int]]) -> None:
    code, body = [HEADER], b""
    for letter, value in values:
        size = struct.calcsize(letter)
        body += bytes(-len(body) % size) + struct.pack("<" + letter, value)
        put = {"f": Operation("OP_PUT_FLOAT"), "d": Operation("OP_PUT_DOUBLE")}.get(letter, Operation("OP_PUT", size))
        code += [real(value) if letter in "fd" else integer(value), put]
    assert machine.message(*code) == CDR_HEADER + body


def test_padding_in_cdr_is_zero(machine: Machine) -> None:
    put = [integer(-1), Operation("OP_PUT", 1), integer(-1), Operation("OP_PUT", 8)]
    known = [integer(-1), Operation("OP_PUT", 1), Operation("OP_KNOWN", 4, data=b"\xff" * 4)]
    body = b"\xff" + bytes(7) + b"\xff" * 9 + bytes(3) + b"\xff" * 4
    assert machine.message(HEADER, *put, *known) == CDR_HEADER + body


@given(st.binary(max_size=9), st.binary(max_size=9))
def test_text_in_cdr_ends_with_a_nul_and_has_no_other(machine: Machine, a: bytes, b: bytes) -> None:
    made = machine.message(HEADER, text(a), Operation("OP_PUT_TEXT"), text(b), Operation("OP_PUT_TEXT"))
    if b"\0" in a + b:
        assert made == Refusal("mapping_error", 2 if b"\0" in a else 4)
        return
    body = struct.pack("<I", len(a) + 1) + a + b"\0"
    body += bytes(-len(body) % 4) + struct.pack("<I", len(b) + 1) + b + b"\0"
    assert made == CDR_HEADER + body


def test_known_bytes_are_aligned(machine: Machine) -> None:
    code = [
        HEADER,
        integer(1),
        Operation("OP_PUT", 1),
        Operation("OP_KNOWN", 8, data=b"\7" * 9),
        text(b"abc"),
        Operation("OP_PUT_BYTES"),
    ]
    assert machine.message(*code) == CDR_HEADER + b"\1" + bytes(7) + b"\7" * 9 + b"abc"


@pytest.mark.parametrize("name", ["OP_PUT_FLOAT", "OP_WRITE_FLOAT"])
def test_a_double_beyond_float32_is_refused(machine: Machine, name: str) -> None:
    assert machine.message(real(3.5e38), Operation(name)) == Refusal("mapping_error", 1)
    assert machine.message(real(float("inf")), Operation(name, size=0)) == struct.pack("<f", float("inf"))


def test_a_long_message_grows(machine: Machine) -> None:
    turn = [text(b"0123456789"), Operation("OP_PUT_BYTES"), Operation("OP_AGAIN")]
    made = machine.message(HEADER, integer(10_000), Operation("OP_REPEAT", size=3), *turn)
    assert made == CDR_HEADER + b"0123456789" * 10_000


# ---- protobuf

_WRITES: dict[str, tuple[str, int]] = {
    "flag": ("OP_WRITE_VARINT", 1 << 3 | VARINT),
    "s64": ("OP_WRITE_ZIGZAG", 2 << 3 | VARINT),
    "f32": ("OP_WRITE_FIXED32", 3 << 3 | I32),
    "sf64": ("OP_WRITE_FIXED64", 4 << 3 | I64),
    "single": ("OP_WRITE_FLOAT", 5 << 3 | I32),
    "real": ("OP_WRITE_DOUBLE", 6 << 3 | I64),
    "gear": ("OP_WRITE_VARINT", 8 << 3 | VARINT),
}
_VALUES: dict[str, st.SearchStrategy[Any]] = {
    "flag": st.booleans(),
    "s64": st.integers(-(1 << 63), (1 << 63) - 1) | st.integers(-9, 9),
    "f32": st.integers(0, (1 << 32) - 1) | st.just(0),
    "sf64": st.integers(-(1 << 63), (1 << 63) - 1) | st.just(0),
    "single": st.floats(width=32) | st.sampled_from([0.0, -0.0, 1e-60]),
    "real": st.floats() | st.sampled_from([0.0, -0.0]),
    "gear": st.integers(-(1 << 31), (1 << 31) - 1) | st.just(0),
}


def _push(value: Any) -> Operation:
    return real(value) if isinstance(value, float) else integer(value)


def _fields(values: dict[str, Any], *, is_kept: bool) -> list[Operation]:
    code = []
    for name, value in values.items():
        kind, number = _WRITES[name]
        code += [_push(value), Operation(kind, flag=int(is_kept), size=number)]
    return code


@given(st.fixed_dictionaries({}, optional=_VALUES))
def test_scalars_in_protobuf(machine: Machine, values: dict[str, Any]) -> None:
    message: Any = _HARD.cases["scalars"].message_class()
    for name, value in values.items():
        setattr(message, name, value)
    in_order = {name: values[name] for name in _WRITES if name in values}
    kept = machine.message(*_fields(in_order, is_kept=True))
    assert isinstance(kept, bytes)
    assert type(message).FromString(kept).SerializeToString(deterministic=True) == message.SerializeToString(
        deterministic=True
    )


@given(st.fixed_dictionaries({}, optional=_VALUES))
def test_what_is_zero_is_left_out_where_it_has_no_presence(machine: Machine, values: dict[str, Any]) -> None:
    made = machine.message(*_fields(values, is_kept=False))
    expected: list[Operation] = []
    for name, value in values.items():
        is_zero = struct.pack("<f", value) == bytes(4) if name == "single" else value == 0 and str(value) != "-0.0"
        if not is_zero:
            expected += _fields({name: value}, is_kept=True)
    assert made == machine.message(*expected)


@given(st.lists(st.integers(-(1 << 63), (1 << 63) - 1), max_size=40), st.binary(max_size=300))
@example([], b"")
@example([1] * 127, b"x" * 127)
@example([1] * 128, b"x" * 128)
@example([1] * 16384, b"")
def test_lengths_of_messages_and_packed_elements(machine: Machine, values: list[int], data: bytes) -> None:
    def zigzag(value: int) -> bytes:
        return varint((value << 1 ^ value >> 63) & (1 << 64) - 1)

    packed = [Operation("OP_OPEN", size=12 << 3 | LEN)]
    for value in values:
        packed += [integer(value), Operation("OP_WRITE_ZIGZAG", flag=1)]
    packed.append(Operation("OP_CLOSE"))
    raw = [text(data), Operation("OP_WRITE_BYTES", size=4 << 3 | LEN)]
    inner = [Operation("OP_OPEN", flag=1, size=16 << 3 | LEN), *packed, *raw, Operation("OP_CLOSE")]
    optional = [Operation("OP_OPEN", flag=0, size=17 << 3 | LEN), *packed, *raw, Operation("OP_CLOSE")]
    content = (delimited(12, b"".join(map(zigzag, values))) if values else b"") + (delimited(4, data) if data else b"")
    expected = delimited(16, content) + (delimited(17, content) if content else b"")
    assert machine.message(*inner, *optional) == expected


def test_payloads_in_payloads(machine: Machine) -> None:
    code, expected = [text(b"y" * 100), Operation("OP_WRITE_BYTES", size=1 << 3 | LEN)], delimited(1, b"y" * 100)
    for _ in range(30):
        code = [Operation("OP_OPEN", flag=1, size=7 << 3 | LEN), *code, Operation("OP_CLOSE")]
        expected = delimited(7, expected)
    assert machine.message(*code) == expected


def test_elements_with_a_tag_each(machine: Machine) -> None:
    keep = [integer(3), integer(-4), Operation("OP_LIST", size=2), Operation("OP_KEEP", 1), Operation("OP_DROP")]
    turn = [Operation("OP_NEXT", 1, flag=11), Operation("OP_WRITE_VARINT", flag=1, size=5 << 3), Operation("OP_AGAIN")]
    made = machine.message(*keep, load(1), Operation("OP_SIZE"), Operation("OP_REPEAT", size=3), *turn)
    assert made == b"\x28\x03\x28" + varint((1 << 64) - 4)


def test_of_a_refused_message_nothing_stays(machine: Machine) -> None:
    broken = [integer(1), Operation("OP_WRITE_VARINT", size=8), integer(1), integer(0), Operation("OP_DIVIDE")]
    assert machine.message(*broken) == Refusal("mapping_error", 4)
    assert machine.message(integer(2), Operation("OP_WRITE_VARINT", size=8)) == b"\x08\x02"
