"""What a mapping fills of a payload: presence, extreme values, enums, bytes, lists, maps, names of every kind."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import HealthCheck, assume, event, example, given, settings
from hypothesis import strategies as st

from router.compiler.constants import envelope_of
from router.compiler.expressions import check
from router.compiler.expressions.functions import FUNCTIONS
from router.compiler.expressions.kinds import StringKind, TimeKind
from router.compiler.lookup import Definitions
from router.compiler.mapping import build
from router.errors import Code, FindingError, MappingError
from router.rehearsal.cdr import serialize as cdr
from router.table.model.expressions import FieldMap
from router.types.model import Bool, Bytes, Field, Float, Int, List, MessageType, String, Type
from router.types.protobuf import PayloadCase
from tests.compiler.compiling import (
    AUTO,
    RECEIVED_AT,
    SPAN,
    chosen,
    context_of,
    field_map,
    findings_of,
    listed,
    outcome,
    scope_of,
    written,
)
from tests.compiler.generated_types import EACH_TYPE, mirror, payload_sources, values
from tests.compiler.machine import FAILURES
from tests.compiler.payloads import (
    Wire,
    as_ros,
    compiled_envelope,
    machine_envelope,
    made,
    made_wire,
    reference_envelope,
    rover_wire,
)
from tests.oracles.reference import fill

I32, I64, U8, U64 = Int(32, True), Int(64, True), Int(8, False), Int(64, False)
F32, F64 = Float(32), Float(64)
POINT = MessageType("made/msg/Point", (Field("x", F32), Field("y", F32)))
ENTRY = MessageType("made/msg/Entry", (Field("key", String()), Field("value", I32)))


def point(x: float, y: float) -> SimpleNamespace:
    return SimpleNamespace(x=x, y=y)


def codes_of(case: str, fields: FieldMap, *source: Field) -> list[Code]:
    schema, envelope = made_wire()
    scope = scope_of(MessageType("made/msg/Source", source), tuple(schema.enums.values()))
    return [finding.code for finding in findings_of(fields, envelope.cases[case].type, scope)]


# presence


def test_nothing_is_set_that_is_not_mapped() -> None:
    assert made("optional", field_map(text="'a'")).ListFields() == [
        (made_wire()[1].cases["optional"].message_class.DESCRIPTOR.fields_by_name["text"], "a")
    ]


@pytest.mark.parametrize(
    ("name", "zero"),
    [("number", "0"), ("single", "0.0"), ("flag", "false"), ("text", "''"), ("data", "[]"), ("rock", "0")],
)
def test_an_optional_field_is_set_to_its_default(name: str, zero: str) -> None:
    assert made("optional", field_map(**{name: zero})).HasField(name)


def test_a_mapped_submessage_is_there_also_when_all_in_it_is_zero() -> None:
    payload = made("optional", field_map(point="p"), p=(POINT, point(0.0, 0.0)))
    assert payload.HasField("point")
    assert not payload.HasField("nothing")


def test_negative_zero_is_no_default() -> None:
    assert math.copysign(1, made("scalars", field_map(single="x"), x=(F32, -0.0)).single) == -1


# scalars


@pytest.mark.parametrize("name", ["i32", "s32", "sf32", "u32", "f32", "i64", "s64", "sf64", "u64", "f64"])
def test_integers_are_kept_up_to_their_bounds_and_refused_beyond(name: str) -> None:
    member = made_wire()[1].cases["scalars"].type.field(name)
    assert member is not None
    assert isinstance(member.type, Int)
    for value in (member.type.low, member.type.high):
        assert getattr(made("scalars", AUTO, **{name: (member.type, value)}), name) == value
        assert getattr(made("scalars", field_map(**{name: str(value)})), name) == value
    for value in (member.type.low - 1, member.type.high + 1):
        assert codes_of("scalars", field_map(**{name: str(value)})) == [Code.OUT_OF_RANGE]
        with pytest.raises(MappingError):
            made("scalars", field_map(**{name: "round(x)"}), x=(F64, value * 2.0))


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan, 3.4028234663852886e38, 1e-45])
@pytest.mark.parametrize("expression", ["x", "x * 1", "float32(y)", "xs[0]"])
def test_what_a_float32_can_hold_passes(value: float, expression: str) -> None:
    given: dict[str, tuple[Type, Any]] = {"x": (F32, value), "y": (F64, value), "xs": (List(F32), (value,))}
    single = made("scalars", field_map(single=expression), **given).single
    assert struct.pack("<f", single) == struct.pack("<f", value)


@pytest.mark.parametrize(
    "fields",
    [field_map(single=expression) for expression in ("x * 2", "float32(y)", "-x * 2 if y > 0 else x", "[x, x * 2][1]",
                                                     "round(y)")],
)  # fmt: skip
def test_a_computed_number_too_large_for_a_float32_is_refused(fields: FieldMap) -> None:
    with pytest.raises(MappingError):
        made("scalars", fields, x=(F32, 3e38), y=(F64, 1e39))


def test_a_computed_list_is_looked_at_number_by_number() -> None:
    fields = field_map(singles="[x, x * 2] if flag else xs")
    given: dict[str, tuple[Type, Any]] = {"x": (F32, 3e38), "xs": (List(F32), (1.5, math.inf))}
    assert made("many", fields, flag=(Bool(), False), **given).singles == [1.5, math.inf]
    with pytest.raises(MappingError):
        made("many", fields, flag=(Bool(), True), **given)


# enums


@pytest.mark.parametrize(
    ("expression", "number"),
    [("ROCK_BLUE", -3), ("'ROCK_BLUE'", -3), ("Rock.ROCK_GREEN", 1), ("77", 77), ("-2147483648", -(1 << 31)),
     ("ROCK_GREEN if flag else ROCK_BLUE", 1), ("'ROCK_' + color", 1), ("color_number", 200), ("wrapped", 5)],
)  # fmt: skip
def test_an_enum_takes_numbers_and_names(expression: str, number: int) -> None:
    payload = made(
        "scalars",
        field_map(rock=expression),
        flag=(Bool(), True),
        color=(String(), "GREEN"),
        color_number=(U8, 200),
        wrapped=(MessageType("made/msg/State", (Field("state", U8),)), SimpleNamespace(state=5)),
    )
    assert payload.rock == number


@pytest.mark.parametrize(("color", "number"), [(0, 0), (7, 1), (8, -3), (9, 5)])
def test_a_map_makes_an_enum_of_a_number(color: int, number: int) -> None:
    rock = chosen("color", {"0": "ROCK_UNKNOWN", "7": "ROCK_GREEN", "8": "Rock.ROCK_BLUE"}, "5")
    assert made("scalars", field_map(rock=rock), color=(U8, color)).rock == number


def test_names_of_an_enum_stand_in_lists() -> None:
    assert made("many", field_map(rocks="[ROCK_BLUE, 1]")).rocks == [-3, 1]
    assert made("many", field_map(rocks="['ROCK_BLUE', 'ROCK_GREEN']")).rocks == [-3, 1]
    assert made("many", AUTO, rocks=(List(String()), ("ROCK_BLUE", "ROCK_GREEN"))).rocks == [-3, 1]


def test_a_field_wins_over_the_name_of_an_enum_value() -> None:
    assert made("scalars", field_map(rock="ROCK_BLUE"), ROCK_BLUE=(U8, 1)).rock == 1


@pytest.mark.parametrize(("case", "name", "value"), [("scalars", "rock", "ROCK_RED"), ("many", "rocks", ("ROCK_RED",))])
def test_an_unknown_name_is_refused_when_it_comes(case: str, name: str, value: object) -> None:
    type_: Type = String() if isinstance(value, str) else List(String())
    with pytest.raises(FAILURES):
        made(case, AUTO, **{name: (type_, value)})


@pytest.mark.parametrize("gear", ["2", "'HIGH'", "HIGH", "number", "name", "gear"])
def test_a_closed_enum_takes_what_it_names(gear: str) -> None:
    given: dict[str, tuple[Type, Any]] = {"number": (U8, 2), "name": (String(), "HIGH"), "gear": (List(U8), [2, 3])}
    assert made("closed", field_map(gear="gear[0]" if gear == "gear" else gear, number="1"), **given).gear == 2


@pytest.mark.parametrize("number", [0, 3])
def test_a_closed_enum_takes_no_other_number(number: int) -> None:
    assert codes_of("closed", field_map(gear=str(number), number="1")) == [Code.UNKNOWN_ENUM_VALUE]
    with pytest.raises(MappingError):
        made("closed", field_map(gear="gear", number="1"), gear=(U8, number))


# bytes and texts


@pytest.mark.parametrize("value", [b"", b"\0\xff", (0, 255), [1]])
def test_a_list_of_octets_fills_bytes(value: Any) -> None:
    assert made("scalars", AUTO, data=(List(U8), value)).data == bytes(value)
    assert made("scalars", field_map(data="[1, 255, 0]")).data == b"\1\xff\0"


@pytest.mark.parametrize(
    ("name", "fits", "too_much"),
    [("text", (String(), "abc"), (String(), "äöü")), ("data", (Bytes(), b"abc"), (Bytes(), b"abcd")),
     ("data", (List(U8), (1, 2, 3)), (List(U8), (1, 2, 3, 4))), ("few", (List(I32), (1, 2)), (List(I32), (1, 2, 3))),
     ("two", (List(POINT), (point(0, 0),) * 2), (List(POINT), (point(0, 0),)))],
)  # fmt: skip
def test_what_is_larger_than_the_boards_expect_is_refused(
    name: str, fits: tuple[Type, Any], too_much: tuple[Type, Any]
) -> None:
    made("bounded", AUTO, **{name: fits})
    with pytest.raises(MappingError):
        made("bounded", AUTO, **{name: too_much})


# messages


def test_a_map_takes_a_list_of_entries_and_keeps_the_last_of_each_key() -> None:
    entries = [SimpleNamespace(key=key, value=value) for key, value in (("a", 1), ("b", 0), ("a", 2))]
    assert dict(made("maps", AUTO, counts=(List(ENTRY), entries)).counts) == {"a": 2, "b": 0}
    wide = MessageType("made/msg/Wide", (Field("number", I32), Field("text", String())))
    narrow = MessageType("made/msg/Entry", (Field("key", I32), Field("value", wide)))
    twice = [
        SimpleNamespace(key=1, value=SimpleNamespace(number=3, text="old")),
        SimpleNamespace(key=1, value=SimpleNamespace(number=0, text="")),
    ]
    optionals = made("maps", AUTO, optionals=(List(narrow), twice)).optionals
    assert (optionals[1].number, optionals[1].text) == (0, "")


def test_a_time_fills_a_timestamp() -> None:
    stamp = made("stamped", field_map(stamp="received_at")).stamp
    assert stamp.seconds * 10**9 + stamp.nanos == RECEIVED_AT
    before = made("stamped", field_map(stamp="time_from_seconds(-0.5)")).stamp
    assert (before.seconds, before.nanos) == (-1, 500_000_000)


def test_fields_may_be_called_as_anything_in_python() -> None:
    entry = MessageType("made/msg/Entry", (Field("key", I32), Field("value", POINT)))
    numbers: dict[str, tuple[Type, Any]] = dict.fromkeys(
        ("from", "None", "self", "SerializeToString", "__debug__"), (I32, 7)
    )
    messages: dict[str, tuple[Type, Any]] = {
        "class": (POINT, point(1, 0)),
        "SetInParent": (POINT, point(2, 0)),
        "is": (List(I32), [1, 2]),
        "in": (List(POINT), [point(3, 0)]),
        "lambda": (List(entry), [SimpleNamespace(key=4, value=point(5, 0))]),
        "it": (POINT, point(6, 0)),
    }
    payload = made("names", AUTO, **numbers, **messages)
    assert {getattr(payload, name) for name in numbers} == {7}
    assert payload.it.x == 6  # the name that the helpers give to the payload
    assert (getattr(payload, "class").x, payload.SetInParent.x, getattr(payload, "in")[0].x) == (1, 2, 3)
    assert (getattr(payload, "is"), getattr(payload, "lambda")[4].x) == ([1, 2], 5)


# what does not fit


@pytest.mark.parametrize(
    ("case", "fields", "code"),
    [
        ("scalars", field_map(rock="'ROCK_GREN'"), Code.UNKNOWN_ENUM_VALUE),
        ("scalars", field_map(rock="ROCK_GREN"), Code.UNKNOWN_FIELD),
        ("scalars", field_map(rock="2147483648"), Code.OUT_OF_RANGE),
        ("scalars", field_map(rock="flag"), Code.TYPE_MISMATCH),
        ("scalars", field_map(data="numbers"), Code.TYPE_MISMATCH),
        ("scalars", field_map(data="[256]"), Code.TYPE_MISMATCH),
        ("scalars", field_map(data="text"), Code.TYPE_MISMATCH),
        ("scalars", field_map(single="real"), Code.LOSSY_CONVERSION),
        ("bounded", field_map(data="[1, 2, 3, 4]"), Code.OUT_OF_RANGE),
        ("bounded", field_map(few="[1, 2, 3]"), Code.OUT_OF_RANGE),
        ("bounded", field_map(two=listed(field_map(x="1"))), Code.TYPE_MISMATCH),
        ("bounded", field_map(two=listed(field_map(x="1", z="2"), field_map(x="1"))), Code.UNKNOWN_FIELD),
        ("choice", field_map(number="1", text="'a'"), Code.DUPLICATE_FIELD),
        ("closed", field_map(gear="LOW"), Code.MISSING_KEY),
        ("optional", field_map(closed__gear="LOW"), Code.MISSING_KEY),
        ("maps", field_map(counts="keys"), Code.MISSING_KEY),
    ],
)
def test_what_cannot_fill_a_payload_is_a_finding(case: str, fields: FieldMap, code: Code) -> None:
    keys = MessageType("made/msg/Keys", (Field("key", String()),))
    source = (
        Field("flag", Bool()), Field("numbers", List(I32)), Field("text", String()), Field("real", F64),
        Field("keys", List(keys)),
    )  # fmt: skip
    assert codes_of(case, fields, *source) == [code]


def test_both_members_of_a_oneof_by_auto_are_a_finding() -> None:
    assert codes_of("choice", AUTO, Field("number", I32), Field("text", String())) == [Code.DUPLICATE_FIELD]
    assert made("choice", AUTO, number=(I32, 0), flag=(Bool(), True)).WhichOneof("chosen") == "number"


GOLDEN: list[dict[str, Any]] = json.loads(
    (Path(__file__).parents[1] / "wire" / "golden_envelopes.json").read_text(encoding="utf-8")
)
_ROS_NAMES = {"imu_info": "ImuSensorInformation"}
"""Of the one ROS type that has another name than its payload."""
MANY = settings(suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])


def canonical(wire: Wire, datagram: Any) -> Any:
    """Entries of maps in one order; what is no datagram as it is."""
    if not isinstance(datagram, bytes):
        return datagram
    return wire[1].message_class.FromString(datagram).SerializeToString(deterministic=True)


@MANY
@given(st.data())
def test_random_mappings_make_the_envelopes_of_the_reference(data: st.DataObject) -> None:
    wire = made_wire()
    case = data.draw(st.sampled_from(list(wire[1].cases.values())))
    source = as_ros(data.draw(payload_sources(case.type)))
    assume(source.fields)
    assume(not findings_of(AUTO, case.type, scope_of(source, tuple(wire[0].enums.values()))))
    message = data.draw(values(mirror(source)))
    made = outcome(lambda: compiled_envelope(wire, case, AUTO, source)(message))
    event("refused" if made is FAILURES else "sent")
    expected = outcome(lambda: reference_envelope(wire, case, AUTO, source)(message))
    assert canonical(wire, made) == canonical(wire, expected)


def test_golden_payloads_mapped_to_themselves_keep_their_bytes() -> None:
    wire = rover_wire()
    for entry in GOLDEN:
        case = wire[1].cases[entry["payload_case"]]
        datagram = wire[1].message_class.FromString(bytes.fromhex(entry["hex"]))
        payload = getattr(datagram, case.name)
        for field in case.type.fields:
            if isinstance(field.type, MessageType):
                getattr(payload, field.name).SetInParent()  # what is mapped is there
        expected = datagram.SerializeToString()
        assert compiled_envelope(wire, case, AUTO, case.type)(payload) == expected
        assert reference_envelope(wire, case, AUTO, case.type)(payload) == expected


def test_ros_messages_of_the_rover_make_the_envelopes_of_the_reference(definitions: Definitions) -> None:
    wire = rover_wire()
    for name, case in wire[1].cases.items():
        declared = definitions.interfaces.get(f"comms/msg/{_ROS_NAMES.get(name, case.type.name)}")
        assert declared is not None
        assert_same_envelopes(wire, case, declared)


def assert_same_envelopes(wire: Wire, case: PayloadCase, declared: MessageType) -> None:
    """Whatever a ROS message of type `declared` holds."""
    compiled = machine_envelope(wire, case, AUTO, declared)
    reference = reference_envelope(wire, case, AUTO, declared)

    @EACH_TYPE
    @given(values(mirror(declared)))
    def equal(message: Any) -> None:
        value = fill(AUTO, declared, context_of(message, mirror(declared)))
        assert compiled(cdr(declared, value)) == reference(message)

    equal()


def constant(case: str, fields: FieldMap) -> bytes:
    schema, envelope = made_wire()
    declared = envelope.cases[case]
    scope = scope_of(MessageType("nothing"), tuple(schema.enums.values()))
    mapping = build(fields, declared.type, scope, SPAN)
    assert mapping.findings == []
    return envelope_of(mapping.plan, declared)


def test_an_envelope_of_constants_is_that_of_the_reference() -> None:
    wire = made_wire()
    for case, fields in {
        "scalars": field_map(single="radians(90) * 0", rock="ROCK_BLUE", text="'stop'", i32="-1", data="[1, 2]"),
        "optional": field_map(flag="true", point__x="0.5"),
        "many": field_map(numbers="[1, 2, 3]", rocks="['ROCK_GREEN']"),
    }.items():
        expected = reference_envelope(wire, wire[1].cases[case], fields, MessageType("nothing"))(None)
        assert constant(case, fields) == expected


@pytest.mark.parametrize(
    "text",
    [
        *(example for function in FUNCTIONS.values() for example, _ in function.examples),
        "-clamp(2 + 3, 0, 9) ** 2",
        "7 // clamp(2, 0, 9) % 2",
        "1 / clamp(2, 0, 9)",
        "[1, 2][1]",
        "(degrees([1.5, 2]) * 2)[0]",
        "1 if clamp(1, 0, 9) < 2 <= 2.0 else 2",
        "1 if clamp(1, 0, 9) < 1 < 1 / int(false) else 2",
        "1 if not (clamp(1, 0, 9) in [2, 3]) and 1 not in [2] or 1 / int(false) > 1 else 2",
        "1 if ['b', 'a'][1] == 'a' else 1 / int(false)",
        "sum(radians([90, 90]))",
        "sum([1, clamp(2, 0, 9)])",
        "sum([clamp(-5, -9, 9), 2])",
    ],
)
def test_constants_are_computed_as_the_reference_does(text: str) -> None:
    kind = check(written(text), scope_of(MessageType("nothing"))).kind
    given = text if isinstance(kind, StringKind) else f"text({'seconds' * isinstance(kind, TimeKind)}({text}), 9)"
    fields = field_map(text=given)
    expected = reference_envelope(made_wire(), made_wire()[1].cases["scalars"], fields, MessageType("nothing"))(None)
    assert constant("scalars", fields) == expected


@given(*[st.floats(-1e6, 1e6)] * 2)
@example(32.6323351048564, 11.392827114328364)
def test_a_constant_is_what_a_mapping_makes_of_the_same_values(x: float, y: float) -> None:
    functions = "hypot({x}, {y})", "atan2({x}, {y})", "cos({x})", "tan({y})", "degrees({x})", "abs({x}) ** 7"
    texts = f"[{', '.join(f'text({each}, 17)' for each in functions)}]"
    source = MessageType("made/msg/Source", (Field("x", F64), Field("y", F64)))
    case = made_wire()[1].cases["many"]
    mapped = compiled_envelope(made_wire(), case, field_map(texts=texts.format(x="x", y="y")), source)
    assert constant("many", field_map(texts=texts.format(x=x, y=y))) == mapped(SimpleNamespace(x=x, y=y))


def test_constants_are_nested_as_deeply_as_in_a_mapping() -> None:
    nested = "1"
    for _ in range(20):
        nested = f"sum([{', '.join('0' * 15)}, {nested}])"
    with pytest.raises(FindingError, match="more than 255 intermediate values are needed here"):
        constant("scalars", field_map(u64=nested))


@pytest.mark.parametrize(
    ("case", "fields"),
    [
        ("scalars", field_map(i32="round(sqrt(-1))")),
        ("scalars", field_map(i32="round(2.0 ** 8 * 1e9)")),
        ("scalars", field_map(text=f"str(sum([clamp({1 << 63}, 0, {1 << 63}), {1 << 63}]))")),
        ("scalars", field_map(rock="'ROCK_' + str(1)")),
        ("scalars", field_map(real="1 / int(false)")),
        ("scalars", field_map(single="float32(1e39)")),
        ("scalars", field_map(i32="([1] if true else [1, 2])[5]")),
    ],
)
def test_an_envelope_of_constants_that_no_payload_holds_is_refused(case: str, fields: FieldMap) -> None:
    with pytest.raises(FindingError):
        constant(case, fields)
