"""From messages of ROS to datagrams: the carrier gives the bytes of the oracle, or refuses where it does."""

from __future__ import annotations

import math
import struct
from ctypes import CDLL
from typing import Any

import pytest
from hypothesis import HealthCheck, assume, event, given, settings
from hypothesis import strategies as st

from router.compiler.lookup import Definitions
from router.rehearsal.cdr import serialize as cdr
from router.types.model import Bool, Field, Float, Int, List, MessageType, String, Type
from router.types.protobuf import PayloadCase
from tests.carrier.mappings import Mapping, from_ros
from tests.compiler.compiling import AUTO, context_of, field_map, outcome
from tests.compiler.generated_types import mirror, payload_sources, values
from tests.compiler.judging import FILTERED, Misfit
from tests.compiler.payloads import as_ros, made_wire, rover_wire
from tests.compiler.test_expressions import SOURCE as PAYLOAD
from tests.oracles.reference import fill
from tests.oracles.reference_kinds import MAPPING_ERROR

MANY = settings(suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
F32, F64, U8, I32, U32, I64, U64 = (
    Float(32), Float(64), Int(8, False), Int(32, True), Int(32, False), Int(64, True), Int(64, False)
)  # fmt: skip


def case_of(name: str) -> PayloadCase:
    return made_wire()[1].cases[name]


def serialized(declared: MessageType, message: Any) -> bytes:
    return cdr(declared, fill(AUTO, declared, context_of(message, mirror(declared))))


def source_of(**fields: Type) -> MessageType:
    return MessageType("made/msg/Source", tuple(Field(name, type_) for name, type_ in fields.items()))


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
                del data[draw(st.integers(min(4, len(data)), len(data))) :]  # behind the header: see below
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
def test_random_mappings_make_the_datagrams_of_the_oracle(delivering: CDLL, data: st.DataObject) -> None:
    wire = made_wire()
    case = data.draw(
        st.sampled_from(["scalars", "optional", "many", "choice", "names", "bounded", "nothing", "closed", "maps"])
    )
    source = as_ros(data.draw(payload_sources(wire[1].cases[case].type)))
    assume(source.fields)
    try:
        mapping = from_ros(delivering, wire, wire[1].cases[case], AUTO, source)
    except Misfit:
        event("nothing in common")
        return
    for _ in range(3):
        message = data.draw(messages(source))
        mapping.check(message)
        made = mapping.check_damaged(data.draw(damaged(message)))
        event("refused" if made == [MAPPING_ERROR] else "sent")


def test_all_commands_of_the_rover_make_the_datagrams_of_the_oracle(delivering: CDLL, definitions: Definitions) -> None:
    """Those of its table, and whatever else boards take."""
    wire = rover_wire()
    for case in wire[1].cases.values():
        declared = definitions.interfaces.get(f"comms/msg/{_ROS_NAMES.get(case.name, case.type.name)}")
        assert declared is not None
        mapping = from_ros(delivering, wire, case, AUTO, declared)
        _assert_allowed(declared, mapping)


_ROS_NAMES = {"imu_info": "ImuSensorInformation"}
"""Of the one ROS type that has another name than its payload."""


def _assert_allowed(declared: MessageType, mapping: Mapping, *, refuses: bool = False) -> None:
    """`refuses` says that a message may be refused."""

    @settings(max_examples=settings().max_examples, suppress_health_check=list(HealthCheck))
    @given(messages(declared), st.data())
    def allowed(message: bytes, data: st.DataObject) -> None:
        assert mapping.check(message) != [MAPPING_ERROR] or refuses
        mapping.check_damaged(data.draw(damaged(message)))

    allowed()


# ---- values


@pytest.mark.parametrize("bits", [0x7F800001, 0xFF812345, 0x7FC00001, 0x7F800000, 0xFF800000, 0x80000000, 0x00000001])
def test_float32_keeps_what_the_handlers_keep(delivering: CDLL, bits: int) -> None:
    message = b"\0\1\0\0" + struct.pack("<I", bits)
    for fields in (field_map(single="x"), field_map(real="x")):
        mapping = from_ros(delivering, made_wire(), case_of("scalars"), fields, source_of(x=F32))
        mapping.check(message)


@pytest.mark.parametrize("value", [0.0, -0.0, math.nan, math.inf, -1e39, 3.4028235677973366e38, 3.4028235677973362e38])
def test_float64_is_narrowed_where_the_table_says_so(delivering: CDLL, value: float) -> None:
    message = b"\0\1\0\0" + struct.pack("<d", value)
    mapping = from_ros(delivering, made_wire(), case_of("scalars"), field_map(single="float32(x)"), source_of(x=F64))
    mapping.check(message)


@pytest.mark.parametrize("name", ["i32", "s32", "sf32", "u32", "f32", "i64", "s64", "sf64", "u64", "f64", "rock"])
def test_integers_are_encoded_up_to_their_bounds(delivering: CDLL, name: str) -> None:
    wire = made_wire()
    member = wire[1].cases["scalars"].type.field(name)
    assert member is not None
    declared = member.type if isinstance(member.type, Int) else I32
    source = source_of(flag=Bool(), x=declared)
    mapping = from_ros(delivering, wire, case_of("scalars"), field_map(**{name: "x"}), source)
    for value in (declared.low, declared.low // 2, 0, 1, 127, 128, declared.high):
        message = cdr(source, {"flag": True, "x": value})
        assert mapping.check(message) != [MAPPING_ERROR]


@pytest.mark.parametrize("declared", [I32, U32, I64, U64])
def test_large_integers_are_rounded_where_the_table_says_so(delivering: CDLL, declared: Int) -> None:
    source = source_of(x=declared)
    for fields in (field_map(single="float32(x)"), field_map(real="float64(x)")):
        mapping = from_ros(delivering, made_wire(), case_of("scalars"), fields, source)
        for value in (declared.low, declared.high, declared.high // 3, (1 << 24) + 1, 0):
            message = cdr(source, {"x": value})
            assert mapping.check(message) != [MAPPING_ERROR]


@pytest.mark.parametrize(
    ("text", "is_read"),
    [(b"", True), (b"\0", True), (b"a", False), (b"a\0", True), (b"\xc3\xa9\0", True), (b"\xc3\0", False),
     (b"\xed\xa0\x80\0", False), (b"abc\0", True), (b"a\0c\0", True), (b"\xf0\x9f\x98\x80\0", True),
     (b"\xf4\x90\x80\x80\0", False)],
)  # fmt: skip
def test_texts_are_decoded_or_refused(delivering: CDLL, text: bytes, is_read: bool) -> None:
    message = b"\0\1\0\0" + struct.pack("<I", len(text)) + text
    for case, name in (("scalars", "text"), ("optional", "text"), ("bounded", "text")):
        mapping = from_ros(delivering, made_wire(), case_of(case), field_map(**{name: "x"}), source_of(x=String()))
        fits = case != "bounded" or len(text) <= 4
        assert (mapping.check_damaged(message) == [MAPPING_ERROR]) != (is_read and fits)


def test_constants_stand_beside_fields(delivering: CDLL) -> None:
    fields = field_map(
        i32="-1", single="radians(90)", text="'stop'", data="[1, 2]", rock="ROCK_BLUE", u32="x", flag="false"
    )
    mapping = from_ros(delivering, made_wire(), case_of("scalars"), fields, source_of(x=U8))
    message = cdr(source_of(x=U8), {"x": 7})
    assert mapping.check(message) != [MAPPING_ERROR]
    fields = field_map(numbers="[1, x, -3]", texts="['a', t, '']", rocks="[ROCK_BLUE]", flags="[]")
    source = source_of(x=U8, t=String())
    mapping = from_ros(delivering, made_wire(), case_of("many"), fields, source)
    for text in ("", "ä", "x" * 300):
        message = cdr(source, {"x": 0, "t": text})
        assert mapping.check(message) != [MAPPING_ERROR]


def test_lists_and_texts_that_are_not_wanted_are_stepped_over(delivering: CDLL) -> None:
    point = MessageType("made/msg/Point", (Field("name", String()), Field("x", F64)))
    line = MessageType(
        "made/msg/Line", (Field("points", List(point)), Field("ids", List(I64)), Field("pair", List(U8, 3)))
    )
    source = source_of(
        texts=List(String()), wide=String(wide=True), lines=List(line), spans=List(MessageType("made/msg/Span", (
            Field("a", U8), Field("b", F64))), None), nothing=MessageType("made/msg/Nothing"), x=I32,
    )  # fmt: skip
    mapping = from_ros(delivering, made_wire(), case_of("scalars"), field_map(i32="x"), source)

    @settings(suppress_health_check=list(HealthCheck))
    @given(st.data())
    def equal(data: st.DataObject) -> None:
        message = data.draw(messages(source))
        assert mapping.check(message) != [MAPPING_ERROR]
        mapping.check_damaged(data.draw(damaged(message)))

    equal()


@pytest.mark.parametrize("head", [b"", b"\0", b"\0\1", b"\0\1\0"])
def test_what_is_shorter_than_its_header_is_refused(delivering: CDLL, head: bytes) -> None:
    mapping = from_ros(delivering, made_wire(), case_of("scalars"), field_map(i32="1"), source_of(x=I32))
    assert mapping.carrier(head) == [MAPPING_ERROR]


@pytest.mark.parametrize("head", [b"\0\1\0\0", b"\0\0\0\0\0\0\0\7", b"\0\7\0\0\0\0\0\7"])
def test_what_is_no_little_endian_cdr_is_refused(delivering: CDLL, head: bytes) -> None:
    for expression in ("x", "1"):
        mapping = from_ros(delivering, made_wire(), case_of("scalars"), field_map(i32=expression), source_of(x=I32))
        is_read = expression == "1" and head[:2] == b"\0\1"
        assert (mapping.carrier(head) == [MAPPING_ERROR]) != is_read


@pytest.mark.parametrize(
    ("name", "expression"),
    [
        ("singles", "float32(xs / max(xs))"),
        ("singles", "float32((xs - sum(xs)) / (max(xs) if len(text) > 1 else xs[0]))"),
        ("singles", "float32(xs / (min(xs) - 1))"),
        ("numbers", "clamp(round(xs), 0, min(len(text), 5))"),
    ],
)
def test_what_is_the_same_for_all_elements_is_computed_once(delivering: CDLL, name: str, expression: str) -> None:
    source = source_of(xs=List(F32), text=String())
    mapping = from_ros(delivering, made_wire(), case_of("many"), field_map(**{name: expression}), source)
    for size in (0, 1, 60, 6000):
        for text in ("", "a" * size):
            message = cdr(source, {"xs": [float(1 + place % 7) for place in range(size)], "text": text})
            if size < 100:
                (made,) = mapping.check(message)
            else:  # 6000 times 6000 turns are too many for a message, and for the oracle
                assert type(mapping.carrier(message)[0]) is type(made)


def test_for_each_refuses_a_list_that_would_hold_up_the_thread(delivering: CDLL) -> None:
    source, wire = source_of(xs=List(U8)), made_wire()
    mapping = from_ros(delivering, wire, case_of("scalars"), field_map(u32="item"), source, for_each="xs")
    most = 1 << 16
    assert len(mapping.carrier(cdr(source, {"xs": [1] * most}))) == most
    assert mapping.carrier(cdr(source, {"xs": [1] * (most + 1)})) == [MAPPING_ERROR]


def test_long_texts_and_lists_get_long_lengths(delivering: CDLL) -> None:
    source = source_of(x=List(U8), t=String())
    fields = field_map(data="x", text="t")
    mapping = from_ros(delivering, made_wire(), case_of("scalars"), fields, source)
    for size in (100, 127, 128, 16_383, 16_384, 65_536, 200_000):
        octets, text = [7] * size, "a" * (size // 7)
        envelope = made_wire()[1].message_class(scalars={"data": bytes(octets), "text": text})
        assert mapping.carrier(cdr(source, {"x": octets, "t": text})) == [envelope.SerializeToString()]
    refused = cdr(source, {"x": [7] * 200_000, "t": "abcdefg"})[:-2]
    assert mapping.carrier(refused) == [MAPPING_ERROR]


# ---- expressions


POINT = MessageType("made/msg/Point", (Field("name", String()), Field("x", F64), Field("ids", List(I64))))
STAMP = MessageType("builtin_interfaces/msg/Time", (Field("sec", I32), Field("nanosec", U32)))
HEADER = MessageType("std_msgs/msg/Header", (Field("stamp", STAMP), Field("frame_id", String())))
SOURCE = source_of(
    header=HEADER, flag=Bool(), u8=U8, i8=Int(8, True), i32=I32, u32=U32, i64=I64, u64=U64, f32=F32, f64=F64,
    text=String(), short=String(3), wide=String(wide=True), octets=List(U8), three=List(I32, 3), few=List(F32, None, 4),
    texts=List(String()), pair=List(String(), 2), points=List(POINT), two=List(POINT, 2), point=POINT,
    times=List(STAMP), flags=List(Bool()), longs=List(U64),
)  # fmt: skip
EXPRESSED = as_ros(PAYLOAD)
"""What the random expressions read, in ROS."""

EXPRESSIONS: list[tuple[str, dict[str, str]]] = [
    ("scalars", {"i32": "round(clamp(100 * (f32 - f64), -100, 100))", "single": "float32(f64 / 3)"}),
    ("scalars", {"text": "text + '/' + short + str(i64) + str(u64) + str(flag)", "flag": "not flag and i32 > u32"}),
    ("scalars", {"data": "octets", "u32": "len(octets)", "i32": "octets[1]", "u64": "len(text)"}),
    ("scalars", {"data": "[u8, 7, clamp(i32, 0, 255)]", "real": "seconds(header.stamp)", "flag": "u8 in [1, i8]"}),
    ("scalars", {"rock": "ROCK_BLUE if u8 > 3 else ROCK_GREEN", "i64": "i64 // i32", "u64": "u64 // 3 % 10"}),
    ("scalars", {"i32": "points[0].ids[1] % 7", "real": "two[1].x", "text": "two[0].name", "single": "few[2]"}),
    ("scalars", {"u32": "len(points)", "i32": "three[2]", "flag": "flags[0]", "real": "seconds(times[0])"}),
    ("scalars", {"text": "texts[0] + pair[1]", "u32": "len(texts)"}),
    ("many", {"numbers": "three", "singles": "few", "texts": "texts", "flags": "flags"}),
    ("many", {"texts": "pair", "rocks": "[1, u8]", "numbers": "[1, i32, -1]"}),
    ("stamped", {"stamp": "received_at"}),
    ("optional", {"number": "i32", "text": "source"}),
]


def test_a_text_without_its_nul_is_refused_where_it_is_used(delivering: CDLL) -> None:
    """Also as a field of an element that a condition leaves out."""
    source, fields = source_of(point=POINT), field_map(text="item.name", u32="index")
    case = case_of("scalars")
    mapping = from_ros(delivering, made_wire(), case, fields, source, "index > 0", "[point, point]")
    message = cdr(source, {"point": {"name": "cut here", "x": 1.0, "ids": []}})
    hostile = message.replace(b"cut here\0", b"cut hereX")
    assert hostile != message
    assert mapping.carrier(hostile) == [FILTERED, MAPPING_ERROR]


@pytest.mark.parametrize(("case", "fields"), EXPRESSIONS)
def test_expressions_have_the_values_of_the_oracle(delivering: CDLL, case: str, fields: dict[str, str]) -> None:
    mapping = from_ros(delivering, made_wire(), case_of(case), field_map(**fields), SOURCE)
    _assert_allowed(SOURCE, mapping, refuses=True)


@pytest.mark.parametrize(
    ("for_each", "fields", "when"),
    [
        ("points", {"text": "item.name", "real": "item.x", "u32": "len(item.ids)", "i32": "clamp(count, 0, 5)"}, ""),
        ("points", {"i32": "clamp(item.ids[0])"}, "item.x > 0"),
        ("two", {"u32": "index"}, "f64 < item.x"),
        ("three", {"i32": "item", "i64": "item * index"}, "item % 2 == 0"),
        ("few", {"single": "item"}, ""),
        ("texts", {"text": "item", "u32": "count"}, "item != ''"),
        ("pair", {"u32": "count"}, ""),
        ("times", {"real": "seconds(item)"}, ""),
        ("octets", {"u32": "item", "i64": "i64"}, ""),
        ("[i32, u32, -1]", {"i64": "item", "text": "'wheel_' + str(index)"}, ""),
        ("longs", {"u64": "item", "flag": "item > f64"}, "index != 1"),
        ("[text, short]", {"text": "item + source"}, "len(item) > 0"),
        ("[point, point]", {"text": "item.name", "u32": "len(points)"}, "index > 0"),
        ("flags", {"flag": "item", "i32": "i8"}, "item"),
    ],
)  # fmt: skip
def test_each_element_is_a_message(delivering: CDLL, for_each: str, fields: dict[str, str], when: str) -> None:
    wire = made_wire()
    mapping = from_ros(delivering, wire, case_of("scalars"), field_map(**fields), SOURCE, when, for_each)
    _assert_allowed(SOURCE, mapping, refuses=True)
