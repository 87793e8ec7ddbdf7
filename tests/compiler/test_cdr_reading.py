"""Reading CDR bytes: the compiled readers and the reference agree, whatever the bytes are."""

from __future__ import annotations

import itertools
import struct
import tracemalloc
from typing import Any

import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

from router.errors import MappingError
from router.rehearsal.cdr import deserialize as parse
from router.rehearsal.cdr import serialize as cdr
from router.types.model import Bool, Field, Float, Int, List, MessageType, String, Type
from tests.compiler.comparing import same
from tests.compiler.compiling import outcome
from tests.compiler.generated_types import values
from tests.compiler.machine import FAILURES
from tests.compiler.reading import TIMES, WHOLE, Path, at, field_values, messages, paths, plain, reader, wanted_paths
from tests.oracles.reference import Value

MANY = settings(suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])


def parsed(declared: MessageType, data: bytes, wanted: list[Path]) -> list[Any]:
    """What the reference reads at each path."""
    found = []
    for path in wanted:
        value: Any = parse(declared, data)
        for name in path:
            value = getattr(value, name)
        found.append(plain(value, at(declared, path)))
    return found


def compiled(declared: MessageType, data: bytes, wanted: list[Path]) -> list[Any]:
    _, read = reader(declared, wanted)
    return [plain(value, at(declared, path)) for path, value in zip(wanted, read(data), strict=True)]


def message(**fields: Type) -> MessageType:
    return MessageType("made/msg/Made", tuple(Field(name, type_) for name, type_ in fields.items()))


@MANY
@given(st.data())
def test_any_fields_are_read_as_the_reference_does(data: st.DataObject) -> None:
    declared = data.draw(messages())
    value = data.draw(values(declared))
    wanted = data.draw(wanted_paths(declared))
    serialized = cdr(declared, field_values(value, declared), data.draw(st.sampled_from([0x00, 0xFF])))
    assert same(compiled(declared, serialized, wanted), parsed(declared, serialized, wanted))
    assert same(compiled(declared, serialized, [WHOLE]), [plain(value, declared)])


@MANY
@given(st.data())
def test_damaged_bytes_are_read_or_refused_as_the_reference_does(data: st.DataObject) -> None:
    declared = data.draw(messages(depth=1))
    serialized = bytearray(cdr(declared, field_values(data.draw(values(declared)), declared)))
    for _ in range(data.draw(st.integers(0, 3))):
        place = data.draw(st.integers(0, len(serialized) - 1))
        damage = data.draw(st.sampled_from([b"\0", b"\xff", b"\xff\xff\xff\xff", b"\1\0\0\0"]) | st.binary(max_size=4))
        serialized[place : place + len(damage)] = damage
    damaged = bytes(serialized[: data.draw(st.none() | st.integers(0, len(serialized)))])
    ours = outcome(lambda: compiled(declared, damaged, [WHOLE]))
    event("refused" if ours is FAILURES else "read")
    assert same(ours, outcome(lambda: parsed(declared, damaged, [WHOLE])))
    some = data.draw(wanted_paths(declared))
    if ours is not FAILURES:
        assert same(compiled(declared, damaged, some), parsed(declared, damaged, some))
    else:
        outcome(lambda: compiled(declared, damaged, some))


NOTHING = message()
HOSTILE: dict[str, Type] = {
    "string": String(), "wstring": String(wide=True), "bytes": List(Int(8, signed=False)), "doubles": List(Float(64)),
    "bools": List(Bool()), "strings": List(String()), "empty messages": List(NOTHING), "times": List(TIMES[0]),
    "messages that hold empty ones": List(message(many=List(NOTHING), one=NOTHING)),
    "messages of strings": List(message(name=String(), last=Float(64))),
}  # fmt: skip


@pytest.mark.parametrize("hostile", HOSTILE)
def test_length_beyond_the_end_is_refused_before_memory_is_taken_for_it(hostile: str) -> None:
    declared = message(hostile=HOSTILE[hostile], last=Float(32))
    for wanted, length in itertools.product(["hostile", "last"], [0xFFFF_FFFF, 0x8000_0000, 100_000]):
        _, read = reader(declared, [(wanted,)])
        data = b"\0\1\0\0" + struct.pack("<I", length) + bytes(1000)
        tracemalloc.start()
        try:
            with pytest.raises(FAILURES):
                read(data)
            assert tracemalloc.get_traced_memory()[1] < 500_000
        finally:
            tracemalloc.stop()


@pytest.mark.parametrize(
    ("data", "name"),
    [("0000000001", "CDR_BE"), ("00030000", "PL_CDR_LE"), ("00070000", "CDR2_LE"), ("1234", "0x1234"), ("00", "0x00")],
)
def test_other_representations_are_refused_by_name(data: str, name: str) -> None:
    _, read = reader(message(number=Int(8, signed=False)), [("number",)])
    with pytest.raises(MappingError, match=name):
        read(bytes.fromhex(data))


def test_representation_options_mean_nothing() -> None:
    _, read = reader(message(number=Int(8, signed=False)), [("number",)])
    assert read(b"\0\1\0\3\7\0\0\0") == [7]


def test_string_of_length_zero_is_empty() -> None:
    _, read = reader(message(text=String(), after=Int(8, signed=False)), [("text",), ("after",)])
    assert read(b"\0\1\0\0" + bytes(4) + b"\7") == ["", 7]


@pytest.mark.parametrize("text", [b"abc", b"\xff\0"], ids=["without NUL", "not UTF-8"])
def test_bad_string_fails_where_it_is_used_and_nowhere_else(text: bytes) -> None:
    declared = message(text=String(), after=Int(8, signed=False))
    data = b"\0\1\0\0" + struct.pack("<I", len(text)) + text + b"\7"
    _, read_after = reader(declared, [("after",)])
    assert read_after(data) == [7]
    _, read_text = reader(declared, [("text",)])
    with pytest.raises(FAILURES):
        read_text(data)
    _, read_elements = reader(message(elements=List(declared, length=1)), [("elements",)])
    ((element,),) = read_elements(data)
    assert element.after == 7
    with pytest.raises(FAILURES):
        _ = element.text


def test_what_follows_the_last_wanted_field_is_not_looked_at() -> None:
    declared = message(first=Int(32, signed=True), text=String(), last=Float(64))
    _, read = reader(declared, [("first",)])
    assert read(b"\0\1\0\0\5\0\0\0" + b"\xff" * 4) == [5]


def test_fields_before_the_first_string_are_one_call() -> None:
    inner = message(x=Float(64), unused=Int(16, signed=True), y=Float(32))
    declared = message(unused=Bool(), inner=inner, last=Int(8, signed=False), text=String())
    text, read = reader(declared, [("inner", "y"), ("last",)])
    assert text.count("unpack") == 1
    value: dict[str, Value] = {"unused": True, "inner": {"x": 1.0, "unused": 2, "y": 3.0}, "last": 4, "text": "five"}
    assert read(cdr(declared, value)) == [3.0, 4]


def test_nothing_wanted_reads_nothing() -> None:
    text, read = reader(message(text=String()), [])
    assert "unpack" not in text
    assert read(b"\0\1\0\0") == []


def test_every_path_has_a_variable_of_its_own() -> None:
    declared = message(a=message(b_c=Bool()), a_b=message(c=Bool()), a_b_c=Bool())
    data = cdr(declared, {"a": {"b_c": True}, "a_b": {"c": False}, "a_b_c": True})
    wanted = [path for path, type_ in paths(declared) if isinstance(type_, Bool)]
    assert compiled(declared, data, wanted) == [True, False, True]
