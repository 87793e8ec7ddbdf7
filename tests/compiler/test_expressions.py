"""Well-typed expressions: the compiled path and the reference agree, and inferred ranges hold."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import strategies as st

from router.compiler import plan
from router.compiler.expressions import ExpressionError, Scope, check
from router.compiler.expressions.functions import FUNCTIONS
from router.compiler.expressions.kinds import (
    INT64,
    UINT64,
    FloatKind,
    IntKind,
    Kind,
    ListKind,
    MessageKind,
    StringKind,
    TimeKind,
    kind_of,
)
from router.compiler.expressions.tree import (
    MESSAGE,
    Binary,
    Each,
    ListLiteral,
    Node,
    Read,
    Unary,
    Variable,
    constant_of,
)
from router.compiler.mapping import build
from router.types.model import Bool, Bytes, Enum, Field, Float, Int, List, MessageType, String, Type
from tests.compiler.compiling import (
    SPAN,
    compiled,
    context_of,
    field_map,
    outcome,
    reference_bytes,
    scope_of,
    serializer,
    written,
)
from tests.compiler.generated_types import values
from tests.compiler.machine import FAILURES
from tests.compiler.reading import TIMES
from tests.oracles.reference_expressions import evaluate


def path_of(node: Node) -> tuple[str, ...] | None:
    """The path of a field of the source message, or of the message itself; None for everything else."""
    names: list[str] = []
    while isinstance(node, Read):
        names.append(node.field.name)
        node = node.holder
    return tuple(reversed(names)) if isinstance(node, Variable) and node.name == MESSAGE else None


MODE = Enum("Mode", (("OFF", 0), ("ON", 1), ("LOUD", 300), ("LESS", -7)))
INNER = MessageType("Inner", (Field("value", Int(16, True)), Field("ratio", Float(64))))
OUTER = MessageType("Outer", (Field("inner", INNER, has_presence=True), Field("b_c", Int(8, True))))
SOURCE = MessageType(
    "Source",
    fields=(
        Field("i8", Int(8, True)), Field("u8", Int(8, False)), Field("i32", Int(32, True)),
        Field("u64", Int(64, False)), Field("i64", Int(64, True)),
        Field("f32", Float(32)), Field("f64", Float(64)), Field("flag", Bool()), Field("name", String()),
        Field("mode", MODE), Field("numbers", List(Int(32, True))), Field("outer", OUTER, has_presence=True),
        Field("three", List(Float(32), 3)), Field("data", Bytes()),
        Field("a", MessageType("A", (Field("b_c", INNER),))),
        Field("a_b", MessageType("AB", (Field("c", INNER),))),
    ),
)  # fmt: skip
TARGETS: list[Type] = [
    Bool(), Int(8, False), Int(8, True), Int(32, True), Int(64, True), Float(32), Float(64), String(), String(5),
]  # fmt: skip


class Present(SimpleNamespace):
    """A protobuf message as far as expressions look."""

    def HasField(self, name: str) -> bool:  # noqa: N802 - protobuf's name
        return getattr(self, name) is not None


def present(declared: Type) -> st.SearchStrategy[Any]:
    if not isinstance(declared, MessageType):
        return values(declared)
    return st.builds(Present, **{field.name: present(field.type) for field in declared.fields})


ROUNDED = IntKind(INT64.low, INT64.high, is_rounded=True)


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("u8 + 1", IntKind(1, 256)),
        ("-i8", IntKind(-127, 128)),
        ("u8 % u8", IntKind(0, 254)),
        ("i8 % -3", IntKind(-2, 0)),
        ("i8 // u8", IntKind(-128, 127)),
        ("i8 // 2", IntKind(-64, 63)),
        ("i8 ** 2", IntKind(0, 128 * 128)),
        ("u8 ** Mode.ON", IntKind(0, 255)),
        ("abs(i8)", IntKind(0, 128)),
        ("min(u8, 10)", IntKind(0, 10)),
        ("max(u8, 10)", IntKind(10, 255)),
        ("clamp(i32, 0, 255)", IntKind(0, 255)),
        ("clamp(i32, i8, u8)", IntKind(-128, 255)),
        ("clamp(round(f64), 0, 9)", IntKind(0, 9)),
        ("wrap(i32, 0, 359)", IntKind(0, 359)),
        ("wrap(i32, i8, u8)", IntKind(-128, 255)),
        ("round(f32)", ROUNDED),
        ("int(flag) * 3", IntKind(0, 3)),
        ("u8 if flag else 1000", IntKind(0, 1000)),
        ("2 + 3 * 4", IntKind(14, 14)),
        ("f32 * 2", FloatKind(32)),
        ("f32 * f64", FloatKind(64)),
        ("i32 / 2", FloatKind(32)),
        ("[i8, u8][0]", IntKind(-128, 255)),
        ("u64 + 1", IntKind(1, UINT64.high)),
        ("u64 - u64", IntKind(INT64.low, INT64.high)),
        ("u64 * i8", IntKind(INT64.low, INT64.high)),
        ("-u64", IntKind(INT64.low, 0)),
        ("u64 if flag else i8", IntKind(-128, INT64.high)),
        ("min(u64, i8)", IntKind(-128, 127)),
        ("max(u64, i8)", IntKind(0, UINT64.high)),
        ("round(clamp(f64, -100, 2.6))", IntKind(-100, 3, is_rounded=True)),
        ("round(clamp(f64, 0, inf))", ROUNDED),
        ("round(f32) + 1", IntKind(INT64.low + 1, INT64.high, is_rounded=True)),
        ("max(round(f32), 0)", IntKind(0, INT64.high, is_rounded=True)),
        ("clamp(f64, -1, 1)", FloatKind(64, -1.0, 1.0)),
        ("clamp(f64, -1, f32)", FloatKind(64)),
        ("numbers / 100", ListKind(FloatKind(32))),
        ("numbers * f64", ListKind(FloatKind(64))),
        ("[i8, 2] + 1", ListKind(IntKind(-127, 128), 2)),
        ("three + numbers", ListKind(FloatKind(32), 3)),
        ("str(numbers)", ListKind(StringKind())),
        ("max(numbers, 0)", ListKind(IntKind(0, (1 << 31) - 1))),
        ("max(numbers)", IntKind(-(1 << 31), (1 << 31) - 1)),
        ("sum(numbers)", IntKind(INT64.low, INT64.high)),
        ("sum([u8, u8, u8])", IntKind(0, 765)),
        ("sum(three)", FloatKind(32)),
        ("data[0]", IntKind(0, 255)),
        ("data % 16", ListKind(IntKind(0, 15))),
    ],
)
def test_inferred_kind(text: str, kind: Kind) -> None:
    node, _ = compiled(text, scope_of(SOURCE, [MODE]))
    assert node.kind == kind


@pytest.mark.parametrize(
    ("text", "is_checked"),
    [
        ("i32 + i32", False), ("u64 + 1", True), ("u64 - 1", True), ("u64 // 2", False), ("-i32", False),
        ("-u64", True), ("i32 ** 2", False), ("i32 ** 3", True), ("i64 // i64", True), ("i64 % i64", False),
        ("u64 + 0.5", False), ("-round(f64)", True), ("round(clamp(f64, 0, 9)) * 100", False),
    ],
)  # fmt: skip
def test_an_operation_is_checked_if_its_result_may_not_fit_64_bits(text: str, is_checked: bool) -> None:
    node = check(written(text), scope_of(SOURCE))
    assert isinstance(node, (Unary, Binary))
    assert node.is_checked == is_checked


def test_an_integer_is_fitted_where_a_choice_or_a_list_cannot_have_it() -> None:
    for text in ("u64 if flag else i8", "[u64, i8][0]", "max([u64, i8])"):
        assert "'fit'" in str(check(written(text), scope_of(SOURCE))), text
    for text in ("u64 if flag else u8", "max(u64, i8)", "u64 == i8", "i8 in [u64]"):
        assert "'fit'" not in str(check(written(text), scope_of(SOURCE))), text


def test_operations_on_lists_are_one_loop() -> None:
    node = check(written("clamp(round(numbers / 100 + three), 0, len(numbers))"), scope_of(SOURCE))
    assert isinstance(node, Each)
    assert [path_of(each) for _, each in node.lists] == [("numbers",), ("three",)]
    assert not isinstance(node.element, Each)
    mapping = build(
        field_map(it="numbers / 100"), MessageType("It", (Field("it", List(Float(32))),)), scope_of(SOURCE), SPAN
    )
    ((_, filled),) = mapping.plan.members
    assert isinstance(filled, plan.Each)
    assert [path_of(each) for _, each in filled.lists] == [("numbers",)]


def test_a_list_literal_is_computed_item_by_item() -> None:
    node = check(written("[i8, 4, 3.0] * three / 2"), scope_of(SOURCE))
    assert isinstance(node, ListLiteral)
    assert [type(item) for item in node.items] == [Binary] * 3
    folded = check(written("[1, 2] / 2"), scope_of(SOURCE))
    assert isinstance(folded, ListLiteral)
    assert [constant_of(item) for item in folded.items] == [0.5, 1.0]


WORDS = MessageType(
    "Words",
    (
        *(Field(name, Int(32, True)) for name in ("from", "class", "in", "is", "not", "None", "True", "with", "ä")),
        Field("as", MessageType("As", (Field("if", Int(8, True), has_presence=True),))),
    ),
)


@pytest.mark.parametrize(
    "text",
    ["from + class", "message.from", "message.in + message.is * message.not", "message . None + message.True", "as.if",
     "has(as.if)", "has(message.as.if)", "from if with in [class] else message.in", "5. in [1]",
     "'in is' == 'with from'"],
)  # fmt: skip
def test_words_of_python_are_names_where_they_mean_nothing_else(text: str) -> None:
    check(written(text), scope_of(WORDS))


@pytest.mark.parametrize(("text", "path"), [
    ("message", ("message",)), ("message.message", ("message",)), ("message.in", ("in",)),
])  # fmt: skip
def test_the_message_is_named_beside_a_field_called_message(text: str, path: tuple[str, ...]) -> None:
    status = MessageType("Status", (Field("message", String()), Field("in", Bool())))
    assert path_of(check(written(text), scope_of(status))) == path


def test_a_submessage_called_message_is_reached_by_its_name() -> None:
    part = MessageType("Part", (Field("in", Bool()),))
    status = MessageType("Status", (Field("message", part), Field("in", Bool())))
    assert path_of(check(written("message.in"), scope_of(status))) == ("message", "in")


@pytest.mark.parametrize(
    ("text", "columns", "words"),
    [
        ("in + 1", "in", "message.in"),
        ("from + message.is.x", "message.is.x", "only messages have fields"),
        ("ä + from + clss", "clss", "did you mean 'class'?"),
        ("'äöü' == from", "'äöü' == from", ""),
    ],
)
def test_findings_beside_words_of_python_are_where_they_belong(text: str, columns: str, words: str) -> None:
    with pytest.raises(ExpressionError) as raised:
        check(written(text), scope_of(WORDS))
    span = raised.value.diagnostic.span
    assert text[span.column - 3 : span.end_column - 3] == columns
    assert words in raised.value.diagnostic.hint


@pytest.mark.parametrize(
    "text",
    ["min(i32, f32)", "max(i32, -inf)", "clamp(f32, 0, 9)", "i32 if flag else f32", "float32(i32)",
     "float32(round(f64))", "mode if flag else 0.5"],
)  # fmt: skip
def test_integer_is_a_float_where_an_expression_gives_either(text: str) -> None:
    """So that `-clamp(x, 0, 9)` is -0.0, like every other float."""
    message = SimpleNamespace(i32=0, f32=-1.0 if "clamp" in text else 1.0, f64=0.25, flag=True, mode=0)
    for whole, value in ((text, "0.0"), (f"-({text})", "-0.0"), (f"({text}) * -3", "-0.0")):
        _, run = compiled(whole, scope_of(SOURCE, [MODE]))
        assert repr(run(message)) == value
        assert repr(evaluate(written(whole), context_of(message, SOURCE, [MODE]))) == value


@pytest.mark.parametrize(
    ("text", "time"),
    [
        ("time_from_seconds(9223372036)", 9223372036 * 10**9),
        ("time_from_seconds(9223372037)", None),
        ("time_from_seconds(-9223372036.854775)", -9223372036854774784),
        ("time_from_seconds(9223372036.854775807)", None),
        ("time_from_milliseconds(-9223372036854)", -9223372036854 * 10**6),
        ("time_from_milliseconds(u64)", None),
        ("time_from_milliseconds(1e300)", None),
    ],
)
def test_a_time_has_64_bits(text: str, time: int | None) -> None:
    _, run = compiled(text, scope_of(SOURCE))
    message = SimpleNamespace(u64=(1 << 64) - 1)
    assert outcome(lambda: run(message)) == (FAILURES if time is None else time)


def test_bounds_of_clamp_and_wrap_come_from_the_field() -> None:
    for text in ("clamp(i32)", "wrap(i32) if flag else clamp(u64)"):
        node, _ = compiled(text, scope_of(SOURCE, [MODE]), Int(8, signed=False))
        assert node.kind == IntKind(0, 255)


def test_nan_goes_through_clamp() -> None:
    _, run = compiled("clamp(f64, 0.0, 1.0)", scope_of(SOURCE))
    assert math.isnan(run(SimpleNamespace(f64=math.nan)))


def test_a_field_or_an_enum_value_called_nan_wins_over_not_a_number() -> None:
    source = MessageType("Source", (Field("nan", Int(32, True)),))
    _, run = compiled("nan + 1", scope_of(source))
    assert run(SimpleNamespace(nan=4)) == 5
    mode = Enum("Mode", (("nan", 7),))
    node, run = compiled("nan", scope_of(SOURCE, [mode]), mode)
    assert run(None) == 7
    assert evaluate(written("nan"), context_of(None, SOURCE, [mode]), mode) == 7
    assert str(node.kind) == "enum Mode"


@pytest.mark.parametrize("text", ["nan", "-nan", "inf", "-inf", "nan if flag else f32", "max(f32, -inf)"])
def test_nan_and_inf_fill_floats_and_nothing_else(text: str) -> None:
    for bits in (32, 64):
        target = MessageType("made/msg/One", (Field("it", Float(bits)),))
        run = serializer(field_map(it=text), target, scope_of(SOURCE))
        message = SimpleNamespace(flag=True, f32=-math.inf)
        made = run(message)
        assert made == reference_bytes(field_map(it=text), target, context_of(message, SOURCE))
        assert struct.unpack_from("<f" if bits == 32 else "<d", made, 4)[0] in (math.inf, -math.inf) or "nan" in text
    for refused in (Bool(), Int(8, False), Int(64, True), String(), MODE):
        target = MessageType("made/msg/One", (Field("it", refused),))
        [found] = build(field_map(it=text), target, scope_of(SOURCE, [MODE]), SPAN).findings
        assert found.hint


def test_submessages_whose_paths_read_alike_stay_apart() -> None:
    scope = scope_of(SOURCE)
    _, run = compiled("a.b_c.value - a_b.c.value", scope)
    inner = [SimpleNamespace(value=number) for number in (30, 4)]
    message = SimpleNamespace(a=SimpleNamespace(b_c=inner[0]), a_b=SimpleNamespace(c=inner[1]))
    assert run(message) == 26


def test_a_source_field_named_as_a_keyword_or_as_a_variable_is_read() -> None:
    names = ("class", "message", "source", "received_at", "m", "data", "values", "v", "abs")
    source = MessageType("Source", tuple(Field(name, Int(32, True)) for name in names))
    message = SimpleNamespace(**{name: index for index, name in enumerate(names)})
    for index, name in enumerate(names[1:], start=1):
        _, run = compiled(f"abs({name}) + 1", scope_of(source))
        assert run(message) == index + 1
    target = MessageType("made/msg/Kept", (Field("class", Int(32, True)),))
    assert serializer(field_map(True), target, scope_of(source))(message)[-4:] == bytes(4)


NOTHING = MessageType("Nothing")
EXAMPLES = [(name, text, value) for name, function in FUNCTIONS.items() for text, value in function.examples]
PYTHON_TYPE: dict[type, tuple[type, ...]] = {
    IntKind: (int,),
    FloatKind: (int, float),
    StringKind: (str,),
    TimeKind: (int,),
}


@pytest.mark.parametrize(("name", "text", "value"), EXAMPLES, ids=[text for _, text, _ in EXAMPLES])
def test_example_is_true_compiled_and_by_reference(name: str, text: str, value: object) -> None:
    node, run = compiled(text, scope_of(NOTHING))
    assert run(None) == value
    assert evaluate(written(text), context_of(None, NOTHING)) == value
    assert name in text
    assert isinstance(run(None), PYTHON_TYPE[type(node.kind)])


def test_functions_have_examples_a_summary_and_a_signature() -> None:
    for name, function in FUNCTIONS.items():
        assert function.examples, name
        assert function.summary.endswith("."), name
        assert function.signature.startswith(f"{name}(")


_UINT8 = Int(8, signed=False)
_, TIME = TIMES
BOX = MessageType("made/msg/Box", (Field("from", String()), Field("area", Float(64)), Field("seen", TIME)))
DECLARED = MessageType(
    "made/msg/Scene",
    (
        Field("left", BOX),
        Field("use_left", Bool()),
        Field("right", BOX),
        Field("boxes", List(BOX)),
        Field("item", _UINT8),
        Field("names", List(String())),
        Field("stamp", TIME),
    ),
)


def scope_over(declared: MessageType, names: Mapping[str, Node]) -> Scope:
    return Scope(declared, (), (), names)


def test_name_beside_the_fields_wins_over_a_field() -> None:
    scope = scope_over(DECLARED, {"item": Variable(kind_of(BOX), SPAN, "item")})
    assert isinstance(check(written("item.area"), scope).kind, FloatKind)
    assert isinstance(check(written("message.item"), scope).kind, IntKind)


def test_misspelt_name_beside_the_fields_is_suggested() -> None:
    scope = scope_over(DECLARED, {"total_count": Variable(kind_of(_UINT8), SPAN, "total_count")})
    with pytest.raises(ExpressionError) as raised:
        check(written("total_cuont"), scope)
    assert "total_count" in raised.value.diagnostic.hint


@pytest.mark.parametrize("text", ["has(left)", "has(item)", "has(item.area)", "has(left.area)"])
def test_has_finds_nothing_that_could_be_missing(text: str) -> None:
    scope = scope_over(DECLARED, {"item": Variable(MessageKind(BOX), SPAN, "item")})
    with pytest.raises(ExpressionError):
        check(written(text), scope)


def test_time_is_a_value() -> None:
    assert check(written("left.seen"), scope_over(DECLARED, {})).kind == TimeKind()
