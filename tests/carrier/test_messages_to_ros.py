"""From payloads to messages of topics: the carrier gives the bytes of the oracle, or refuses where it does."""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Callable
from ctypes import CDLL
from functools import cache, partial
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

from router.compiler import Checked, check_table
from router.compiler.checked import CheckedRoute
from router.compiler.compiled_table import CompiledTable
from router.compiler.lookup import Definitions, nested_types
from router.rehearsal.cdr import deserialize
from router.rehearsal.cdr import serialize as cdr
from router.table.model.expressions import FieldMap
from router.types.model import Bool, Bytes, Enum, Field, Float, Int, List, MessageType, String, Type
from router.types.wire import delimited
from tests.carrier.decisions import CarrierSide
from tests.carrier.delivering import Delivering, Payload
from tests.carrier.mappings import to_ros
from tests.carrier.messages import payloads
from tests.compiler.compiling import AUTO, RECEIVED_AT, SOURCE, chosen, context_of, field_map
from tests.compiler.generated_types import EACH_TYPE, defaults
from tests.compiler.judging import Misfit, published, verdict
from tests.compiler.payloads import Wire, made_wire, rover_wire, wire_of
from tests.oracles.reference_kinds import MAPPING_ERROR
from tests.tables import ROUTES

MANY = settings(max_examples=6 * settings().max_examples, suppress_health_check=list(HealthCheck))
BENCHMARKS = Path(__file__).parents[2] / "benchmarks" / "tables"
F32, F64, U8, I16, I32, U32, I64, U64 = (
    Float(32), Float(64), Int(8, False), Int(16, True), Int(32, True), Int(32, False), Int(64, True), Int(64, False)
)  # fmt: skip


@cache
def hard_wire() -> Wire:
    return wire_of(Path(__file__).parent / "protos", "PBEnvelope")


def target_of(**fields: Type) -> MessageType:
    return MessageType("made/msg/Target", tuple(Field(name, type_) for name, type_ in fields.items()))


# ---- tables


@pytest.fixture(scope="module", params=["rover", "legacy", "own"])
def checked(request: pytest.FixtureRequest, definitions: Definitions) -> Checked:
    folder = BENCHMARKS if request.param == "own" else ROUTES
    return check_table(folder / f"{request.param}.yaml", {}, definitions)


def test_topics_of_tables_get_what_the_oracle_makes(library: CDLL, delivering: CDLL, checked: Checked) -> None:
    assert checked.program is not None
    routes = [route for route in checked.routes if any(target.topic for target in route.targets)]
    assert routes
    reading = CarrierSide(library, checked.program)
    for route in routes:
        _assert_allowed(delivering, reading, checked.program, route)


def _assert_allowed(library: CDLL, reading: CarrierSide, program: CompiledTable, route: CheckedRoute) -> None:
    lowered, case, envelope = program.lowered.to_topics[route.route.name], route.case, program.envelopes.first
    topics = [target for target in route.targets if target.topic]
    assert lowered.targets.keys() == {topic.label for topic in topics}
    carrier, enums = Delivering(library, lowered, RECEIVED_AT, SOURCE), rover_wire()[0].enums.values()

    def check(data: bytes, message: Any, payload: Payload | None = None) -> None:
        got = {outcome.label: outcome.got for outcome in carrier.datagram(data, payload)}
        for topic in topics:
            assert topic.type is not None
            assert topic.declared.fields is not None
            context = context_of(message, case.type, [*enums], [*nested_types(topic.type)])
            make = partial(published, topic.type, topic.declared.fields, context)
            assert verdict(make, topic.declared.when, context).allows(got[topic.label])

    routed = [program.envelopes.numbers[name] for name in program.inbound]

    @EACH_TYPE
    @given(payloads(case), st.randoms())
    def allowed(made: list[bytes], noise: random.Random) -> None:
        for payload in made:
            check(payload, case.message_class.FromString(payload))
            parts = [delimited(case.number, payload), delimited(case.number, noise.choice(made))]
            parts += [
                delimited(30, b"unknown"),
                delimited(noise.choice(routed), b""),
            ]
            noise.shuffle(parts)
            whole = b"".join(parts)
            parsed: Any = envelope.message_class.FromString(whole)
            if parsed.WhichOneof(envelope.choice.oneof) == case.name:
                reading.decide(whole, repairs=False)
                check(whole, getattr(parsed, case.name), reading.payload())

    allowed()


# ---- random mappings


def targets(payload: Type, depth: int = 2) -> st.SearchStrategy[Type]:
    """Types of ROS that a field of a payload fills, or is refused for when it runs."""
    match payload:
        case Int():
            wider = [Int(bits, signed) for bits in (8, 16, 32, 64) for signed in (True, False)]
            wider = [each for each in wider if each.low <= payload.low and payload.high <= each.high]
            return st.sampled_from([*wider, *([F64] if payload.bits <= 32 else [])])
        case Enum():
            return st.sampled_from([U8, I16, I32, I64])
        case Float():
            return st.sampled_from([F32, F64] if payload.bits == 32 else [F64])
        case String():
            return st.builds(String, st.sampled_from([None, None, 3, 8]))
        case Bytes():
            return st.sampled_from([List(U8), List(U8, 1), List(U8, None, 8), List(U32), List(I16, None, 2)])
        case List():
            lengths = st.sampled_from([(None, None), (None, None), (2, None), (None, 3)])
            return st.builds(lambda element, limits: List(element, *limits), targets(payload.element, depth), lengths)
        case MessageType():
            return _messages_of(payload, depth)
        case _:
            return st.just(payload)


@st.composite
def _messages_of(draw: st.DrawFn, payload: MessageType, depth: int) -> MessageType:
    fields = [field for field in payload.fields if depth or not _has_messages(field.type)]
    fields = [field for field in fields if _exists_in_ros(field.type)]
    if not fields:
        return MessageType("made/msg/Empty")
    chosen = draw(st.lists(st.sampled_from(fields), min_size=1, unique=True))
    made = [Field(field.name, draw(targets(field.type, depth - 1))) for field in chosen]
    unset: st.SearchStrategy[Type] = st.sampled_from([F64, I16, String(), List(F32, 2), List(I64)])
    for place, declared in enumerate(draw(st.lists(unset, max_size=3))):
        made.append(Field(f"unset_{place}", declared, default=draw(defaults(declared))))
    return MessageType("made/msg/Made", tuple(draw(st.permutations(made))))


def _has_messages(declared: Type) -> bool:
    return isinstance(declared.element if isinstance(declared, List) else declared, MessageType)


def _exists_in_ros(declared: Type) -> bool:
    return not isinstance(declared, List) or not isinstance(declared.element, (Bytes, List))


MADE = ["scalars", "optional", "many", "choice", "names", "stamped", "closed", "nothing", "bounded"]
HARD = ["tree", "texts", "scalars", "old", "far"]


@MANY
@given(st.sampled_from([*((made_wire, case) for case in MADE), *((hard_wire, case) for case in HARD)]), st.data())
def test_random_mappings_make_the_messages_of_the_oracle(
    delivering: CDLL, declared: tuple[Callable[[], Wire], str], data: st.DataObject
) -> None:
    wire = declared[0]()
    case = wire[1].cases[declared[1]]
    target = data.draw(targets(case.type))
    assert isinstance(target, MessageType)
    try:
        mapping = to_ros(delivering, wire, case, AUTO, target)
    except Misfit:
        event("nothing in common")
        return
    for payload in data.draw(payloads(case)):
        (made,) = mapping.check(payload)
        event(made if isinstance(made, str) else "published")


# ---- what is lowered


SCALARS, OPTIONAL, MANY_OF, CHOICE, BOUNDED, NAMES, STAMPED = (
    "scalars", "optional", "many", "choice", "bounded", "names", "stamped"
)  # fmt: skip
POINT = MessageType("made/msg/Point", (Field("y", F64), Field("x", F32)))
TIME = MessageType("builtin_interfaces/msg/Time", (Field("sec", I32), Field("nanosec", U32)))
KINDS = MessageType(
    "made/msg/Kinds", (Field("kind", U8, default=3), Field("name", String(), default="n")), {"ROUND": 2, "NAME": "ab"}
)
NESTED = MessageType("made/msg/Nested", (Field("points", List(POINT)), Field("numbers", List(I64))))
LOWERED: list[tuple[str, FieldMap, MessageType]] = [
    (MANY_OF, AUTO, target_of(points=List(POINT), singles=List(F64), texts=List(String()), flags=List(Bool()))),
    (MANY_OF, AUTO, target_of(many=List(NESTED), numbers=List(I32), rocks=List(I16))),
    (MANY_OF, AUTO, target_of(numbers=List(I32, 2), points=List(POINT, 1), many=List(NESTED, None, 2))),
    (MANY_OF, AUTO, target_of(texts=List(String(3)), singles=List(F32, None, 3), rocks=List(U8))),
    (MANY_OF, field_map(a="numbers[0]", b="points[1].x", c="many[0].many[1].texts[0]", d="[numbers[0], 1]"),
     target_of(a=I32, b=F32, c=String(), d=List(I32))),
    (MANY_OF, field_map(a="many[0].numbers", b="many[0].points", c="len(many[1].texts)", d="many[0].points[0]"),
     target_of(a=List(I64), b=List(POINT), c=U32, d=POINT)),
    (SCALARS, field_map(data="data", n="len(data)", some="data", few="data"),
     target_of(data=List(U8), n=U32, some=List(I16), few=List(U8, 2))),
    (SCALARS, field_map(kind="Kinds.ROUND", a="Kinds.NAME + text + source", b="Rock.ROCK_BLUE", c="i32 in [1, 2, u32]"),
     MessageType("made/msg/T", (*KINDS.fields, Field("a", String()), Field("b", I16), Field("c", Bool())))),
    (SCALARS, field_map(a="1 < i32 <= 300 < u32", b="not flag or i32 == 2 and real > 1", c="'' < text < 'b' != 'a'"),
     target_of(a=Bool(), b=Bool(), c=Bool())),
    (SCALARS, field_map(a="str(i32) + str(flag) + str(u64) + str(rock)", b="text", c="clamp(rock)", d="wrap(i32)"),
     target_of(a=String(), b=String(3), c=U8, d=I16)),
    (OPTIONAL, field_map(a="has(number)", b="has(point) and point.x > 1", c="number if has(number) else -1", d="point"),
     target_of(a=Bool(), b=Bool(), c=I32, d=POINT)),
    (OPTIONAL, field_map(a="has(nothing)", b="has(closed)", c="closed.number"), target_of(a=Bool(), b=Bool(), c=I32)),
    (CHOICE, field_map(a="has(number)", b="has(point)", c="point.y", d="text", e="number", f="has(text)"),
     target_of(a=Bool(), b=Bool(), c=F32, d=String(), e=I32, f=Bool())),
    (STAMPED, field_map(a="received_at", b="time_from_seconds(stamp.seconds)", c="seconds(received_at)",
                        d="time_from_milliseconds(stamp.nanos / 3)"), target_of(a=TIME, b=TIME, c=F64, d=TIME)),
    (BOUNDED, AUTO, target_of(text=String(3), data=List(U8, None, 3), few=List(I32, None, 2), two=List(POINT, 2))),
    (NAMES, field_map(a="__debug__", b="message.SetInParent.x", c="SerializeToString"), target_of(a=I32, b=F32, c=I32)),
]  # fmt: skip
CALLS = ["abs(i32)", "min(i32, 3, single)", "max(i32, u32)", "round(clamp(real, -1e9, 1e9))", "trunc(single)",
         "floor(clamp(real, 0, 5))", "ceil(single)", "clamp(i64, -5, 5)", "wrap(i32, -180, 179)", "radians(i32)",
         "degrees(single)", "sqrt(real)", "sin(real)", "cos(real)", "tan(real)", "atan2(real, single)",
         "float32(real)", "float64(u64)", "int(flag) + int(rock)", "len(text)", "i32 * u32 - 7", "i64 // 7 % 5",
         "u64 // 3", "i32 ** 2", "single ** 3", "real // single", "real % single", "i32 / 8 if flag else 1 / i32",
         "wrap(round(real), 0, 359)", "clamp(round(real), -5, 5)", "i32 % i32", "i32 // i32", "real / u32",
         "min([u32] if flag else [u64, 5])", "sum([u32] if flag else [u64])"]  # fmt: skip
CHOICES = [
    chosen("rock", {"ROCK_GREEN": "1", "ROCK_BLUE": "i32"}, "3"),
    chosen("rock", {"ROCK_BLUE": "1", "ROCK_UNKNOWN": "2", "ROCK_GREEN": "3"}),
    chosen("flag", {"true": "i32", "false": "0 - i32"}),
    chosen("i32", {"0": "7", "-1": "8"}, "u32"), chosen("text", {"": "1", "a": "2"}, "3"),
]  # fmt: skip
LOWERED += [(SCALARS, field_map(it=choice), target_of(it=I64)) for choice in CHOICES]
LOWERED += [(SCALARS, field_map(it=f"float64({text})"), target_of(it=F64)) for text in CALLS]


@pytest.mark.parametrize(("case", "fields", "target"), LOWERED)
def test_what_is_lowered_makes_the_messages_of_the_oracle(
    delivering: CDLL, case: str, fields: FieldMap, target: MessageType
) -> None:
    wire = made_wire()
    declared = wire[1].cases[case]
    mapping = to_ros(delivering, wire, declared, fields, target, ros_types=(KINDS,))

    @EACH_TYPE
    @given(payloads(declared))
    def same(made: list[bytes]) -> None:
        for payload in made:
            mapping.check(payload)

    same()


# ---- limits


@pytest.mark.parametrize(
    ("it", "target", "made"),
    [
        (" if flag else ".join(["i32"] * 50), I32, 7),
        ("min(" + ", ".join(["i32"] * 1000) + ")", I32, 7),
        ("max(" + ", ".join(["i32 // 2"] * 17_000) + ")", I32, 3),
        ("[" + ", ".join(["i32"] * 1000) + "] if flag else [" + ", ".join(["2"] * 300) + "]", List(I32), [2] * 300),
    ],
)
def test_large_expressions_are_lowered(delivering: CDLL, it: str, target: Type, made: object) -> None:
    wire = made_wire()
    case = wire[1].cases["scalars"]
    mapping = to_ros(delivering, wire, case, field_map(it=it), target_of(it=target))
    assert mapping.carrier(case.message_class(i32=7).SerializeToString()) == [cdr(target_of(it=target), {"it": made})]


def test_a_long_path_is_lowered(delivering: CDLL) -> None:
    wire = made_wire()
    fields = field_map(it="many[0]." * 20 + "numbers[0]")
    mapping = to_ros(delivering, wire, wire[1].cases["many"], fields, target_of(it=I32))
    assert mapping.check(b"") == [MAPPING_ERROR]


@pytest.mark.parametrize("text", [b"", b"a", b"\xff", b"\xed\xa0\x80", "é".encode()])
@pytest.mark.parametrize(
    ("it", "declared"),
    [("text", String()), ("len(text)", U32), ("text == 'a'", Bool()), ("texts", List(String())), ("texts[0]", String()),
     ("len(texts)", U32), ("needed", I32)],
)  # fmt: skip
def test_text_that_protobuf_does_not_check_is_checked_where_it_is_used(
    delivering: CDLL, it: str, declared: Type, text: bytes
) -> None:
    wire = hard_wire()
    case = wire[1].cases["old"]
    mapping = to_ros(delivering, wire, case, field_map(it=it), target_of(it=declared))
    payload = delimited(7, text) + delimited(8, b"first") + delimited(8, text)
    assert (mapping.check(payload) == [MAPPING_ERROR]) == (text[:1] in (b"\xff", b"\xed") and it != "needed")


def test_hypot_differs_by_the_last_bit_at_most(delivering: CDLL) -> None:
    """Python computes it by an algorithm of its own, which changes from version to version."""
    wire = made_wire()
    declared = wire[1].cases["scalars"]
    fields, target = field_map(it="hypot(real, single)"), target_of(it=F64)
    mapping = to_ros(delivering, wire, declared, fields, target)

    @EACH_TYPE
    @given(payloads(declared))
    def same(made: list[bytes]) -> None:
        for payload in made:
            (found,), (expected,) = mapping.carrier(payload), mapping.oracle(payload)
            assert isinstance(found, bytes)
            assert expected.message is not None
            (bits,), (others,) = struct.unpack_from("<q", found, 4), struct.unpack_from("<q", expected.message, 4)
            is_nan = all(math.isnan(*struct.unpack_from("<d", each, 4)) for each in (found, expected.message))
            assert is_nan or abs(bits - others) <= 1  # in Python 3.10, the sign of a NaN depends on the processor

    same()


def test_elements_are_read_as_often_as_they_are_used(delivering: CDLL) -> None:
    """Each time takes room for the list in the element, which nearly fills a datagram."""
    wire = made_wire()
    declared = wire[1].cases["many"]
    fields = {f"n{index}": f"many[0].numbers[{index}]" for index in range(40)}
    target = target_of(many=List(NESTED), again=List(NESTED), **dict.fromkeys(fields, I32))
    mapping = to_ros(delivering, wire, declared, field_map(again="many", many="many", **fields), target)
    for numbers in ([*range(100)], [2] * 16_000):
        (made,) = mapping.carrier(declared.message_class(many=[{"numbers": numbers}]).SerializeToString())
        assert isinstance(made, bytes)
        message = deserialize(target, made)
        assert [getattr(message, name) for name in fields] == numbers[:40]
        assert message.again[0].numbers == message.many[0].numbers == numbers


def test_long_texts_are_joined_or_refused(delivering: CDLL) -> None:
    wire = made_wire()
    declared = wire[1].cases["scalars"]
    fields, target = (
        field_map(it=" + ".join(["text"] * 10), short="text + text"),
        target_of(it=String(), short=String(9)),
    )
    mapping = to_ros(delivering, wire, declared, fields, target)
    for size in (0, 4, 5, 16_000):
        payload = declared.message_class(text="ä" * (size // 2) + "x" * (size % 2)).SerializeToString()
        mapping.check(payload)
