"""Routines: what is made of expressions and mappings, operation by operation, and what is too large for one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from router.compiler import check_table
from router.compiler.checked import Target
from router.compiler.expressions import check
from router.compiler.lookup import Definitions
from router.compiler.lowering import operations, sources
from router.compiler.lowering.cdr import cdr_message
from router.compiler.lowering.layout import ReadOperation
from router.compiler.lowering.names import TooLargeError
from router.compiler.lowering.operations import Operation, Routine, depths, most_executed
from router.compiler.lowering.protobuf import protobuf_message
from router.compiler.lowering.sources import MOST_CONDITION_OPERATIONS, Datagram, RosMessage
from router.compiler.mapping import build
from router.declared import MOST_OPEN, MOST_SECTIONS_DEEP, Op, ReadKind, Scalar, Sign
from router.errors import Code
from router.table.model.expressions import FieldMap
from router.types.model import Field, Float, Int, List, MessageType, String, Type
from tests.compiler.compiling import AUTO, SPAN, each, field_map, scope_of, written
from tests.compiler.conftest import CheckText
from tests.compiler.payloads import made_wire, wire_of
from tests.compiler.test_expressions import MODE
from tests.tables import ROUTES

ENDPOINTS = """{board: {address: 127.0.0.2:8, kind: board}, base: {address: 127.0.0.3:9000, kind: basestation}, \
tool: {address: 127.0.0.4:9000, kind: tool, trim_trailing_zeros: true}}"""
HARD = Path(__file__).parents[1] / "carrier" / "protos"
F32, F64, U8, I32, U32, I64, U64 = (
    Float(32), Float(64), Int(8, False), Int(32, True), Int(32, False), Int(64, True), Int(64, False)
)  # fmt: skip
POINT = MessageType("made/msg/Point", (Field("x", F64), Field("y", F64)))
SOURCE = MessageType("made/msg/Source", (
    Field("u8", U8), Field("i32", I32), Field("i64", I64), Field("u64", U64), Field("f64", F64),
    Field("text", String()), Field("list", List(I32)), Field("other", List(F32)), Field("points", List(POINT)),
    Field("texts", List(String())),
))  # fmt: skip


def listed(code: Sequence[Operation]) -> str:
    """The names of operations, with the fields that they load and the numbers in them."""
    return " ".join(_shown(each) for each in code)


def _shown(operation: Operation) -> str:
    name = operation.kind.name.lower()
    slot = operation.slot
    if isinstance(slot, operations.Slot):
        return f"{name}:{slot.name or 't'}"
    if operation.kind in (Op.INTEGER, Op.REAL):
        return f"{operation.number}"
    if operation.kind in (Op.KNOWN, Op.TEXT):
        return f"{name}:{operation.data.hex()}"
    return f"{name}:{operation.size}" if operation.kind in (Op.JUMP, Op.UNLESS, Op.AND, Op.OR, Op.REPEAT) else name


def lowered(text: str) -> Routine:
    return RosMessage(SOURCE, "topic").lowering().value(check(written(text), scope_of(SOURCE, [MODE])))


# ---- expressions


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("i32 + 1", "load:i32 1 add"),
        ("i64 + 1", "load:i64 1 checked_add"),
        ("f64 * 2", "load:f64 2.0 real_multiply"),
        ("f64 * Mode.LESS", "load:f64 -7.0 real_multiply"),
        ("i32 / 2", "load:i32 integer_to_real 2.0 real_divide"),
        ("i32 ** 3", "load:i32 keep:t load:t checked_multiply load:t checked_multiply"),
        ("u8 ** 2", "load:u8 keep:t load:t multiply"),
        ("clamp(round(f64), 0, 9)", "load:f64 round 0 9 clamp"),
        ("i32 if f64 > 1 else 2", "1 load:f64 compare unless:2 load:i32 jump:1 2"),
        ("0 < i32 < 9 and u8 == 1", "0 load:i32 keep:t compare and:3 load:t 9 compare and:3 load:u8 1 compare"),
        ("text + 'a'", "load:text utf8 text:61 join"),
        ("points[2].x", "load:points element enter load:points[].x"),
        ("len(list)", "load:list size"),
    ],
)  # fmt: skip
def test_expressions_become_operations(text: str, expected: str) -> None:
    assert listed(lowered(text)) == expected


@pytest.mark.parametrize(
    ("text", "flag"),
    [
        ("i64 + u64", Sign.SECOND_UNSIGNED),
        ("u64 + 1", Sign.FIRST_UNSIGNED | Sign.RESULT_UNSIGNED),
        ("u64 - u64", Sign.FIRST_UNSIGNED | Sign.SECOND_UNSIGNED),
        ("i64 * i64", 0),
        ("abs(i64) + 1", Sign.FIRST_UNSIGNED | Sign.RESULT_UNSIGNED),
    ],
)
def test_signs_follow_from_ranges(text: str, flag: int) -> None:
    assert lowered(text)[-1].flag == flag


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("sum(list)", "0 load:list keep:t size repeat:3 next:t checked_add again"),
        (
            "sum(list * 2)",
            "0 load:list keep:t size repeat:5 next:t 2 multiply checked_add again",
        ),
        (
            "1 in list",
            "1 keep:t drop 0 load:list keep:t size repeat:5 next:t load:t compare either again",
        ),
        (
            "max(list)",
            "load:list keep:t element load:t keep:t size repeat:3 next:t greatest again",
        ),
        ("len(texts)", "load:texts keep:t size repeat:4 next:t utf8 drop again load:texts size"),
    ],
)
def test_lists_are_gone_through_in_loops(text: str, expected: str) -> None:
    assert listed(lowered(text)) == expected


def test_lists_side_by_side_have_one_length() -> None:
    made = listed(lowered("len(list + other)"))
    both = "load:list keep:t size load:other keep:t size same_count"
    assert made.startswith(f"list keep:t drop {both} repeat:")
    assert made.endswith("real_add append:t again load:t size")


# ---- messages in CDR


Fields = dict[str, tuple[Type, str]]


def to_ros(**fields: tuple[Type, str]) -> str:
    target = MessageType("made/msg/Target", tuple(Field(name, declared) for name, (declared, _) in fields.items()))
    mapped = field_map(**{name: text for name, (_, text) in fields.items() if text})
    plan = build(mapped, target, scope_of(SOURCE), SPAN).plan
    placed = cdr_message(RosMessage(SOURCE, "topic").lowering(), plan)
    return listed([operation for operation, _ in placed])


def test_what_is_known_is_written_at_once() -> None:
    fields: Fields = {"a": (U8, "1"), "b": (F64, ""), "c": (I32, "i32"), "d": (U8, "2"), "e": (String(), "'x'")}
    first = "known:0001000001" + "00" * 7 + "00" * 8
    assert to_ros(**fields) == f"{first} load:i32 put known:02000000" + "02000000" + "7800"


def test_behind_a_text_padding_is_left_to_the_machine() -> None:
    fields: Fields = {"a": (String(), "text"), "b": (I32, "1"), "c": (F64, "2"), "d": (U8, "3")}
    known = "known:01000000 known:0000000000000040" + "03"
    assert to_ros(**fields) == f"known:00010000 load:text utf8 put_text {known}"


def test_an_element_goes_from_a_list_to_the_message() -> None:
    assert to_ros(a=(List(F64), "list")) == (
        "known:00010000 load:list keep:t size keep:t put load:t repeat:4 next:t integer_to_real put_double again"
    )
    assert to_ros(a=(List(I32, None, 3), "list")).startswith(
        "known:00010000 load:list keep:t size fit_count keep:t put"
    )


# ---- payloads


def to_payload(case: str, fields: dict[str, str]) -> str:
    _, envelope = made_wire()
    declared = envelope.cases[case]
    plan = build(field_map(**fields), declared.type, scope_of(SOURCE, made_wire()[0].enums.values()), SPAN).plan
    return listed([each for each, _ in protobuf_message(RosMessage(SOURCE, "topic").lowering(), plan, declared)])


def test_fields_stand_by_their_numbers_and_known_ones_together() -> None:
    made = to_payload("scalars", {"flag": "true", "u32": "7", "i32": "i32", "single": "1.5", "text": "text"})
    known = "known:2007" + "5d0000c03f" + "6801"
    assert made == f"open load:i32 write_varint {known} load:text utf8 write_bytes close"


def test_a_payload_without_fields_of_the_message_is_known() -> None:
    assert to_payload("scalars", {"i32": "-1"}) == "known:0a0b08" + "ff" * 9 + "01"
    assert to_payload("many", {"numbers": "[1, 2]"}) == "known:8201040a020102"
    assert to_payload("scalars", {"u32": "0"}) == "known:0a00"
    assert to_payload("optional", {"number": "0"}) == "known:7a020800"


def test_elements_are_packed() -> None:
    assert to_payload("many", {"numbers": "list"}) == (
        "open open load:list keep:t size repeat:3 next:t write_varint again close close"
    )


# ---- what is read


def steps(declared: MessageType, *wanted: str) -> tuple[ReadOperation, ...]:
    source = RosMessage(declared, "topic")
    for text in wanted:
        source.lowering().value(check(written(text), scope_of(declared)))
    return source.layout(SPAN).sections[0].reads  # type: ignore[return-value]


def test_what_is_not_wanted_is_skipped_in_one_step() -> None:
    inner = MessageType("made/msg/Inner", (Field("a", U8), Field("b", F64), Field("c", List(U8, 3))))
    declared = MessageType(
        "made/msg/Outer", (Field("one", inner), Field("two", inner), Field("x", F64), Field("y", F64))
    )
    assert steps(declared, "x") == (
        ReadOperation(ReadKind.SKIP, 1, elements=35),
        ReadOperation(ReadKind.SCALAR, type=Scalar.FLOAT64, slot=2),
    )


def test_behind_a_text_what_is_skipped_is_aligned_first() -> None:
    declared = MessageType(
        "made/msg/Outer", (Field("text", String()), Field("a", U8), Field("b", F64), Field("c", U8), Field("x", I32))
    )
    assert steps(declared, "x") == (
        ReadOperation(ReadKind.SEQUENCE, 1),
        ReadOperation(ReadKind.SKIP, 1, elements=1),
        ReadOperation(ReadKind.SKIP, 8, elements=1),
        ReadOperation(ReadKind.SKIP, 1, elements=1),
        ReadOperation(ReadKind.SCALAR, type=Scalar.INT32, slot=2),
    )


def test_elements_of_lists_are_read_as_far_as_they_are_wanted() -> None:
    source = RosMessage(SOURCE, "topic")
    source.lowering().value(check(written("points[0].x + points[1].y"), scope_of(SOURCE)))
    made = source.layout(SPAN)
    assert [len(section.reads) for section in made.sections[1:]] == [1, 2]
    assert made.names[made.sections[2].first_slot] == "points[].y"


def test_nothing_is_read_for_nothing() -> None:
    assert steps(SOURCE, "1 + 1") == ()


# ---- limits


def test_the_depth_of_branches_is_that_of_the_deeper_one() -> None:
    assert max(depths(lowered(" if f64 > 1 else ".join(["i32"] * 50)))) == 2
    assert max(depths(lowered("min(" + ", ".join(["i32"] * 300) + ")"))) == 2
    assert max(depths(lowered("[" + ", ".join(["i32"] * 300) + "] if f64 > 1 else list"))) == 2


def test_a_loop_counts_with_all_elements_that_a_datagram_can_have() -> None:
    assert most_executed(lowered("i32 + 1 > 2")) == 5
    one = most_executed(lowered("sum(list) > 2"))
    assert 3 * 16_384 < one < 4 * 16_384
    assert 2 * one < most_executed(lowered("sum(list + sum(list)) > 2")) < 5 * one  # the inner sum is computed once


@pytest.mark.parametrize(
    "when",
    [
        "min(singles) > 0.5",
        "3 in numbers and 4 in numbers",
        "min(singles / 100) < 0.5",
        "min(singles / max(singles)) < 0.5",
        "sum(numbers) % 2 == 0",
        "len(points) > 1",
    ],
)
def test_a_condition_of_the_receive_thread_may_look_into_a_list(when: str) -> None:
    assert 0 < most_executed(of_many(when)) <= MOST_CONDITION_OPERATIONS


@pytest.mark.parametrize(
    "when",
    ["3 in numbers and 4 in numbers and 5 in numbers and 6 in numbers", " + ".join(["sum(numbers)"] * 6) + " > 1"],
)
def test_a_condition_of_the_receive_thread_is_bounded(when: str) -> None:
    with pytest.raises(TooLargeError) as caught:
        of_many(when)
    found = caught.value.diagnostic
    assert found.message.startswith("this could take ")
    assert (found.code, found.span.line) == (Code.TOO_LARGE, 7)
    assert of_many(when, is_bounded=False)  # that of a topic


def of_many(when: str, *, is_bounded: bool = True) -> Routine:
    _, envelope = made_wire()
    case = envelope.cases["many"]
    source = Datagram(case)
    node = check(written(when), scope_of(case.type))
    return source.condition(source.lowering(), [node], is_bounded=is_bounded)[0]


def test_lists_in_lists_are_bounded() -> None:
    declared, fields = MessageType("made/msg/Leaf", (Field("numbers", List(I32)),)), field_map(numbers="numbers")
    for _ in range(2, 9):
        declared = MessageType("made/msg/Many", (Field("many", List(declared)),))
        fields = field_map(many=each("many", fields))
        assert findings("many", declared) == findings("many", declared, fields) == []
    declared, fields = (
        MessageType("made/msg/Many", (Field("many", List(declared)),)),
        field_map(many=each("many", fields)),
    )
    too_many = ["more than 8 lists are nested here"]
    assert findings("many", declared) == findings("many", declared, fields) == too_many


def test_text_that_is_put_together_is_bounded() -> None:
    assert lowered(" + ".join(["text"] * 10))
    with pytest.raises(TooLargeError, match="can reach 1064960 bytes; the limit is 1048576"):
        lowered(" + ".join(["text"] * 11))


def test_messages_in_messages_are_bounded() -> None:
    """The payload is the first one of those that are written."""
    _, envelope = wire_of(HARD, "PBEnvelope")
    case = envelope.cases["tree"]

    def written_as_deep(depth: int) -> None:
        plan = build(field_map(**{"__".join(seeds(depth)): "text"}), case.type, scope_of(SOURCE), SPAN).plan
        source = RosMessage(SOURCE, "topic")
        source.sent(source.lowering(), plan, case)

    written_as_deep(MOST_OPEN - 1)
    with pytest.raises(TooLargeError, match="more than 32 messages are nested here"):
        written_as_deep(MOST_OPEN + 1)


def test_what_is_read_is_bounded() -> None:
    """A field of the payload is one message deep."""
    _, envelope = wire_of(HARD, "PBEnvelope")
    case = envelope.cases["tree"]

    def read_as_deep(depth: int) -> None:
        source = Datagram(case)
        source.lowering().value(check(written(".".join(seeds(depth))), scope_of(case.type)))
        source.layout(SPAN)

    read_as_deep(MOST_SECTIONS_DEEP - 3)
    with pytest.raises(TooLargeError, match="this reads a field 32 messages deep; the limit is 31"):
        read_as_deep(MOST_SECTIONS_DEEP - 1)


def seeds(depth: int) -> list[str]:
    """The path of a text that is so many messages deep in the payload, an odd number."""
    return [*(["seed", "tree"] * depth)[:depth], "name"]


def findings(name: str, target: MessageType, fields: FieldMap = AUTO) -> list[str]:
    _, envelope = made_wire()
    case = envelope.cases[name]
    plan = build(fields, target, scope_of(case.type), SPAN).plan
    source = Datagram(case)
    try:
        source.published(source.lowering(), plan)
        source.layout(SPAN)
    except TooLargeError as error:
        return [error.diagnostic.message]
    return []


# ---- what is lowered


def test_targets_are_lowered_by_what_feeds_them(check_text: CheckText) -> None:
    routes = """\
        routes:
          imu_info:
            source: board
            destinations: [base, {endpoint: tool, when: accel_x > 1}]
            topics:
              - {topic: a, type: std_msgs/msg/Float32, fields: {data: accel_x}}
              - {topic: b, type: std_msgs/msg/Float32, fields: {data: accel_x}, max_rate: 1 Hz, on_limit: latest}
          ph_info: {source: board, destinations: [base]}
          gps_info:
            source: {topic: gps, type: std_msgs/msg/Float32}
            destinations: [base, {endpoint: tool, fields: {altitude: data * 2}}]
            fields: {altitude: data}
    """
    program = check_text(routes, endpoints=ENDPOINTS).program
    assert program is not None
    lowered = program.lowered
    assert {route: list(each.targets) for route, each in lowered.to_destinations.items()} == {"imu_info": ["tool"]}
    assert {route: list(each.targets) for route, each in lowered.to_topics.items()} == {"imu_info": ["a", "b"]}
    (feed,) = lowered.from_ros["gps"]
    assert (feed.route, list(feed.targets)) == ("gps_info", ["base", "tool"])


def test_each_target_is_lowered_once(definitions: Definitions, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    def counted(target: Target, places: tuple[str, ...], **routines: Any) -> Target:
        made.append(places[-1])
        return replace(target, places=places, **routines)

    monkeypatch.setattr(sources, "replace", counted)
    program = check_table(ROUTES / "rover.yaml", {}, definitions).program
    assert program is not None
    assert made
    assert len(made) == len(set(made))
