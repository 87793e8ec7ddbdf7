"""From payloads to messages of topics: the carrier gives the bytes of the generated handlers, or refuses as they do."""

from __future__ import annotations

import random
from collections.abc import Callable
from ctypes import CDLL
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

from router.compiler import check_table
from router.compiler.expressions import ExpressionError
from router.compiler.lookup import Definitions
from router.compiler.lowering.messages import Unlowered
from router.compiler.program import Handler, Program
from router.types.model import Bool, Bytes, Enum, Field, Float, Int, List, MessageType, String, Type
from router.types.wire import delimited
from tests.carrier.compositions import FILTERED, Composer, both
from tests.carrier.messages import payloads
from tests.compiler.compiling import AUTO, Published, field_map
from tests.compiler.generated_types import defaults
from tests.compiler.payloads import Wire, made_wire, wire_of
from tests.compiler.test_expressions import filled_fields, texts
from tests.tables import ROUTES

MANY = settings(max_examples=10 * settings().max_examples, suppress_health_check=list(HealthCheck))
SOME = settings(max_examples=settings().max_examples, suppress_health_check=list(HealthCheck))
BENCHMARKS = Path(__file__).parents[2] / "benchmarks" / "tables"
F32, F64, U8, I16, I32, U32, I64, U64 = (
    Float(32), Float(64), Int(8, False), Int(16, True), Int(32, True), Int(32, False), Int(64, True), Int(64, False)
)  # fmt: skip


@cache
def source_wire() -> Wire:
    return wire_of(Path(__file__).parent / "protos", "source.Envelope")


@cache
def hard_wire() -> Wire:
    return wire_of(Path(__file__).parent / "protos", "PBEnvelope")


def target_of(**fields: Type) -> MessageType:
    return MessageType("made/msg/Target", tuple(Field(name, type_) for name, type_ in fields.items()))


# ---- tables


@pytest.fixture(scope="module", params=["rover", "legacy", "own"])
def program(request: pytest.FixtureRequest, definitions: Definitions) -> Program:
    folder = BENCHMARKS if request.param == "own" else ROUTES
    made = check_table(folder / f"{request.param}.yaml", {}, definitions).program
    assert made is not None
    return made


def test_topics_of_tables_get_the_same_messages(composing: CDLL, program: Program) -> None:
    carried = 0
    for number, handlers in program.inbound.items():
        for handler in handlers:
            if handler.route in program.lowered:
                _assert_same(composing, program, number, handler)
                carried += len(program.lowered[handler.route].targets)
    assert carried == sum(executor.is_carrier for (_, _, to), executor in program.executors.items() if to is None)
    assert carried > 0


def _assert_same(library: CDLL, program: Program, number: int, handler: Handler) -> None:
    serve = Published(program, handler)
    carrier = Composer(library, program.lowered[handler.route])
    parse = handler.case.message_class.FromString

    def in_python(message: Any) -> dict[str, bytes | str]:
        published = serve(message)
        refused = {report.target: report.reason for report in serve.reports}
        return {topic: published.get(topic) or refused.get(topic, FILTERED) for topic in carried}

    carried = program.lowered[handler.route].targets

    @SOME
    @given(payloads(handler.case), st.randoms())
    def same(made: list[bytes], noise: random.Random) -> None:
        for payload in made:
            expected = in_python(parse(payload))
            assert {topic: carrier(payload, topic) for topic in carried} == expected
            parts = [delimited(number, payload), delimited(number, noise.choice(made)), delimited(30, b"unknown")]
            parts.append(delimited(noise.choice([*program.inbound]), b""))
            noise.shuffle(parts)
            envelope = b"".join(parts)
            parsed = program.envelope.message_class.FromString(envelope)
            if parsed.WhichOneof(program.envelope.oneof) != handler.case.name:
                continue
            expected = in_python(getattr(parsed, handler.case.name))
            assert {topic: carrier(envelope, topic, is_single=False) for topic in carried} == expected

    same()


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
def test_random_mappings_make_the_same_messages(
    composing: CDLL, declared: tuple[Callable[[], Wire], str], data: st.DataObject
) -> None:
    wire = declared[0]()
    case = wire[1].cases[declared[1]]
    target = data.draw(targets(case.type))
    assert isinstance(target, MessageType)
    try:
        python, carrier = both(composing, wire, case, AUTO, target)
    except Unlowered as reason:
        event(f"needs Python: {str(reason).split(':')[-1]}")
        return
    except AssertionError:
        event("nothing in common")
        return
    for payload in data.draw(payloads(case)):
        expected = python(payload)
        event(expected if isinstance(expected, str) else "published")
        assert carrier(payload) == expected


# ---- expressions


@MANY
@given(filled_fields(), texts("b", 2), st.data())
def test_random_expressions_have_the_same_values(
    composing: CDLL, filled: tuple[Type, str], when: str, data: st.DataObject
) -> None:
    declared, text = filled
    wire = source_wire()
    case = wire[1].cases["source"]
    try:
        python, carrier = both(composing, wire, case, field_map(it=text), target_of(before=Bool(), it=declared), when)
    except (AssertionError, ExpressionError):
        event("does not fit")
        return
    except Unlowered as reason:
        event(f"needs Python: {str(reason).rsplit(': ', maxsplit=1)[-1]}")
        return
    for payload in data.draw(payloads(case)):
        expected = python(payload)
        event(expected if isinstance(expected, str) else "published")
        assert carrier(payload) == expected, (text, when)
