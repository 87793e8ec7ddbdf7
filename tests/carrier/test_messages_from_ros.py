"""From CDR bytes to datagrams: the carrier gives the bytes of the generated handlers, or refuses as they do."""

from __future__ import annotations

import math
import struct
from ctypes import CDLL
from typing import Any

import pytest
from hypothesis import HealthCheck, assume, event, given, settings
from hypothesis import strategies as st

from router.compiler.cdr import CdrReads
from router.compiler.commands import NeedsPythonError
from router.compiler.lookup import Definitions
from router.rehearsal.cdr import serialize as cdr
from router.table.model import FieldMap
from router.types.model import Bool, Bytes, Enum, Field, Float, Int, List, MessageType, String, Type
from tests.carrier.conversions import Convert, by_carrier, in_python, lowered
from tests.compiler.compiling import AUTO, context_of, field_map, outcome
from tests.compiler.generated_types import mirror, payload_sources, values
from tests.compiler.payloads import Wire, compiled_envelope, made_wire, rover_wire
from tests.oracles.reference import fill

MANY = settings(suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
F32, F64, U8, I32, U32, I64, U64 = (
    Float(32), Float(64), Int(8, False), Int(32, True), Int(32, False), Int(64, True), Int(64, False)
)  # fmt: skip


def both(library: CDLL, wire: Wire, case: str, fields: FieldMap, source: MessageType) -> tuple[Convert, Convert]:
    """Python's function and the carrier's. Raises NeedsPythonError."""
    declared = wire[1].cases[case]
    carried = by_carrier(library, lowered(wire, declared, fields, source))
    return in_python(compiled_envelope(wire, declared, fields, source, CdrReads(source))), carried


def serialized(declared: MessageType, message: Any) -> bytes:
    return cdr(declared, fill(AUTO, declared, context_of(message, mirror(declared))))


def source_of(**fields: Type) -> MessageType:
    return MessageType("made/msg/Source", tuple(Field(name, type_) for name, type_ in fields.items()))


def as_ros(declared: Type) -> Any:
    """A type that ROS has, whose values fill the same fields."""
    match declared:
        case Bytes():
            return List(U8)
        case Enum():
            return U8
        case List():
            return List(as_ros(declared.element), declared.length, declared.bound)
        case MessageType():
            possible = [field for field in declared.fields if _exists_in_ros(field.type)]
            return MessageType(declared.name, tuple(Field(field.name, as_ros(field.type)) for field in possible))
        case _:
            return declared


def _exists_in_ros(declared: Type) -> bool:
    """There are no lists of lists, and messages with nothing else in them have nothing in common with others."""
    match declared:
        case List():
            return not isinstance(declared.element, (Bytes, List)) and _exists_in_ros(declared.element)
        case MessageType():
            return not declared.fields or any(_exists_in_ros(field.type) for field in declared.fields)
        case _:
            return True


def messages(declared: MessageType) -> st.SearchStrategy[bytes]:
    return values(mirror(declared)).map(lambda value: outcome(lambda: serialized(declared, value))).filter(_is_message)


def _is_message(made: object) -> bool:
    return isinstance(made, bytes)  # and no refusal: a ROS string cannot hold a NUL


@st.composite
def damaged(draw: st.DrawFn, message: bytes) -> bytes:
    """Cut, longer, or with other bytes, among them those of lengths."""
    data = bytearray(message)
    for _ in range(draw(st.integers(1, 3))):
        match draw(st.sampled_from(["cut", "longer", "byte", "length"])):
            case "cut":
                del data[draw(st.integers(0, len(data))) :]
            case "longer":
                data += draw(st.binary(max_size=9))
            case "byte" if data:
                data[draw(st.integers(0, len(data) - 1))] = draw(st.integers(0, 255))
            case "length" if len(data) >= 8:
                at = 4 * draw(st.integers(1, len(data) // 4 - 1))
                small = st.integers(0, len(data) + 8)
                huge = st.sampled_from([0xFFFF_FFFF, 0x8000_0000, 0x2000_0000, 0x7FFF_FFFF])
                data[at : at + 4] = struct.pack("<I", draw(small | huge))
    return bytes(data)


# ---- random types and messages


@MANY
@given(data=st.data())
def test_random_mappings_make_the_same_datagrams(library: CDLL, data: st.DataObject) -> None:
    wire = made_wire()
    case = data.draw(st.sampled_from(["scalars", "optional", "many", "choice", "names", "bounded", "nothing"]))
    source = as_ros(data.draw(payload_sources(wire[1].cases[case].type)))
    assume(source.fields)
    try:
        python, carrier = both(library, wire, case, AUTO, source)
    except NeedsPythonError as error:
        event(f"needs Python: {error}")
        return
    for _ in range(3):
        message = data.draw(messages(source))
        assert carrier(message) == python(message)
        hostile = data.draw(damaged(message))
        event("refused" if python(hostile) is None else "sent")
        assert carrier(hostile) == python(hostile)


def test_all_commands_of_the_rover_make_the_same_datagrams(library: CDLL, definitions: Definitions) -> None:
    """Those of its table, and whatever else boards take."""
    wire = rover_wire()
    lowerable = 0
    for case in wire[1].cases.values():
        declared = definitions.interfaces.get(f"comms/msg/{_ROS_NAMES.get(case.name, case.type.name)}")
        assert declared is not None
        try:
            python, carrier = both(library, wire, case.name, AUTO, declared)
        except NeedsPythonError:
            continue
        lowerable += 1
        _assert_equal(declared, python, carrier)
    assert lowerable > len(wire[1].cases) // 2


_ROS_NAMES = {"imu_info": "ImuSensorInformation"}
"""Of the one ROS type that has another name than its payload."""


def _assert_equal(declared: MessageType, python: Convert, carrier: Convert) -> None:
    @settings(max_examples=settings().max_examples, suppress_health_check=list(HealthCheck))
    @given(st.data())
    def equal(data: st.DataObject) -> None:
        message = data.draw(messages(declared))
        assert carrier(message) == python(message) is not None
        hostile = data.draw(damaged(message))
        assert carrier(hostile) == python(hostile)

    equal()


# ---- values


@pytest.mark.parametrize("bits", [0x7F800001, 0xFF812345, 0x7FC00001, 0x7F800000, 0xFF800000, 0x80000000, 0x00000001])
def test_float32_keeps_what_the_handlers_keep(library: CDLL, bits: int) -> None:
    message = b"\0\1\0\0" + struct.pack("<I", bits)
    for fields in (field_map(single="x"), field_map(real="x")):
        python, carrier = both(library, made_wire(), "scalars", fields, source_of(x=F32))
        assert carrier(message) == python(message)


@pytest.mark.parametrize("value", [0.0, -0.0, math.nan, math.inf, -1e39, 3.4028235677973366e38, 3.4028235677973362e38])
def test_float64_is_narrowed_where_the_table_says_so(library: CDLL, value: float) -> None:
    message = b"\0\1\0\0" + struct.pack("<d", value)
    python, carrier = both(library, made_wire(), "scalars", field_map(single="float32(x)"), source_of(x=F64))
    assert carrier(message) == python(message)


@pytest.mark.parametrize("name", ["i32", "s32", "sf32", "u32", "f32", "i64", "s64", "sf64", "u64", "f64", "rock"])
def test_integers_are_encoded_up_to_their_bounds(library: CDLL, name: str) -> None:
    wire = made_wire()
    member = wire[1].cases["scalars"].type.field(name)
    assert member is not None
    declared = member.type if isinstance(member.type, Int) else I32
    source = source_of(flag=Bool(), x=declared)
    python, carrier = both(library, wire, "scalars", field_map(**{name: "x"}), source)
    for value in (declared.low, declared.low // 2, 0, 1, 127, 128, declared.high):
        message = cdr(source, {"flag": True, "x": value})
        assert carrier(message) == python(message) is not None


@pytest.mark.parametrize("declared", [I32, U32, I64, U64])
def test_large_integers_are_rounded_where_the_table_says_so(library: CDLL, declared: Int) -> None:
    source = source_of(x=declared)
    for fields in (field_map(single="float32(x)"), field_map(real="float64(x)")):
        python, carrier = both(library, made_wire(), "scalars", fields, source)
        for value in (declared.low, declared.high, declared.high // 3, (1 << 24) + 1, 0):
            message = cdr(source, {"x": value})
            assert carrier(message) == python(message) is not None


@pytest.mark.parametrize(
    "text",
    [b"", b"\0", b"a", b"a\0", b"\xc3\xa9\0", b"\xc3\0", b"\xed\xa0\x80\0", b"abc\0", b"a\0c\0", b"abcdefg\0",
     b"\xf0\x9f\x98\x80\0", b"\xf4\x90\x80\x80\0"],
)  # fmt: skip
def test_texts_are_decoded_or_refused(library: CDLL, text: bytes) -> None:
    message = b"\0\1\0\0" + struct.pack("<I", len(text)) + text
    for case, name in (("scalars", "text"), ("optional", "text"), ("bounded", "text")):
        python, carrier = both(library, made_wire(), case, field_map(**{name: "x"}), source_of(x=String()))
        assert carrier(message) == python(message)


def test_constants_stand_beside_fields(library: CDLL) -> None:
    fields = field_map(
        i32="-1", single="radians(90)", text="'stop'", data="[1, 2]", rock="ROCK_BLUE", u32="x", flag="false"
    )
    python, carrier = both(library, made_wire(), "scalars", fields, source_of(x=U8))
    message = cdr(source_of(x=U8), {"x": 7})
    assert carrier(message) == python(message) is not None
    fields = field_map(numbers="[1, x, -3]", texts="['a', t, '']", rocks="[ROCK_BLUE]", flags="[]")
    source = source_of(x=U8, t=String())
    python, carrier = both(library, made_wire(), "many", fields, source)
    for text in ("", "ä", "x" * 300):
        message = cdr(source, {"x": 0, "t": text})
        assert carrier(message) == python(message) is not None


def test_lists_and_texts_that_are_not_wanted_are_stepped_over(library: CDLL) -> None:
    point = MessageType("made/msg/Point", (Field("name", String()), Field("x", F64)))
    line = MessageType(
        "made/msg/Line", (Field("points", List(point)), Field("ids", List(I64)), Field("pair", List(U8, 3)))
    )
    source = source_of(
        texts=List(String()), wide=String(wide=True), lines=List(line), spans=List(MessageType("made/msg/Span", (
            Field("a", U8), Field("b", F64))), None), nothing=MessageType("made/msg/Nothing"), x=I32,
    )  # fmt: skip
    python, carrier = both(library, made_wire(), "scalars", field_map(i32="x"), source)

    @settings(suppress_health_check=list(HealthCheck))
    @given(st.data())
    def equal(data: st.DataObject) -> None:
        message = data.draw(messages(source))
        assert carrier(message) == python(message) is not None
        hostile = data.draw(damaged(message))
        assert carrier(hostile) == python(hostile)

    equal()


@pytest.mark.parametrize(
    "head", [b"", b"\0", b"\0\1", b"\0\1\0", b"\0\1\0\0", b"\0\0\0\0\0\0\0\7", b"\0\7\0\0\0\0\0\7"]
)
def test_what_is_no_little_endian_cdr_is_refused(library: CDLL, head: bytes) -> None:
    for fields in (field_map(i32="x"), field_map(i32="1")):
        python, carrier = both(library, made_wire(), "scalars", fields, source_of(x=I32))
        assert carrier(head) == python(head)


def test_more_than_a_datagram_holds_is_converted_to_nothing_that_could_be_sent(library: CDLL) -> None:
    source = source_of(x=List(U8), t=String())
    fields = field_map(data="x", text="t")
    python, carrier = both(library, made_wire(), "scalars", fields, source)
    for size in (65_000, 65_507, 65_536, 200_000):
        message = cdr(source, {"x": [7] * size, "t": "a"})
        assert carrier(message) == python(message) is not None
    refused = cdr(source, {"x": [7] * 200_000, "t": "abcdefg"})[:-2]
    assert carrier(refused) == python(refused)


# ---- what needs Python


@pytest.mark.parametrize(
    ("case", "fields", "reason"),
    [
        ("scalars", field_map(i32="x + 1"), "`i32: x + 1` needs it"),
        ("scalars", field_map(text="str(x)"), "`text: str(x)` needs it"),
        ("scalars", field_map(text="w"), "`text: w` needs it"),
        ("scalars", field_map(single="floats[0]"), "`single: floats[0]` needs it"),
        ("many", field_map(texts="ts"), "`texts: ts` needs it"),
        ("many", field_map(points="points"), "`points: points` needs it"),
        ("closed", field_map(gear="x", number="1"), "`gear: x` needs it"),
        ("stamped", field_map(stamp="received_at"), "`stamp: received_at` needs it"),
        ("scalars", field_map(i32="clamp(x, 0, 5)"), "`i32: clamp(x, 0, 5)` needs it"),
    ],
)
def test_what_cannot_be_lowered_is_said(library: CDLL, case: str, fields: FieldMap, reason: str) -> None:
    point = MessageType("made/msg/Point", (Field("x", F32), Field("y", F32)))
    source = source_of(x=U8, w=String(wide=True), floats=List(F32), ts=List(String()), points=List(point))
    with pytest.raises(NeedsPythonError) as caught:
        both(library, made_wire(), case, fields, source)
    assert str(caught.value) == reason
    assert caught.value.span.line == 7
