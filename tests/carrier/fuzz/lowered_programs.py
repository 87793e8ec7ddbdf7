"""Programs that the compiler makes: of the tests' tables, and of mappings in both directions that use much of it."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

from router.compiler import check_table
from router.compiler.checked import CheckedRoute, CheckedSubscription, Target
from router.compiler.expressions import Scope, check
from router.compiler.expressions.kinds import UINT32, ListKind
from router.compiler.expressions.tree import COUNT, INDEX, ITEM, Node, Variable
from router.compiler.lowering import Lowered, LoweredFeed, LoweredRoute, lower_table
from router.compiler.lowering.operations import Routine
from router.compiler.mapping import build
from router.errors import Located
from router.rehearsal.cdr import serialize
from router.table.model.expressions import FieldMap
from router.table.model.targets import Destination, Topic
from router.types.model import Bool, Field, Float, Int, List, MessageType, String, Type
from router.types.wire import delimited
from tests.carrier import evaluating
from tests.carrier.datagrams import Maker
from tests.carrier.fuzz.random_programs import ForEach, Program
from tests.compiler.compiling import AUTO, SPAN, field_map, written
from tests.compiler.payloads import made_wire
from tests.tables import ROUTES

BENCHMARKS = Path(__file__).parents[3] / "benchmarks" / "tables"
U8, I16, I32, U32, I64, U64, F32, F64 = (
    Int(8, False), Int(16, True), Int(32, True), Int(32, False), Int(64, True), Int(64, False), Float(32), Float(64)
)  # fmt: skip

Seeds = Callable[[], "tuple[bytes, bytes]"]
"""Makes a message for a program, and one of protobuf in pieces, or nothing."""


class Fuzzed(NamedTuple):
    program: Program
    seeds: Seeds


def _type(**fields: Type) -> MessageType:
    return MessageType("made/msg/Fuzzed", tuple(Field(name, type_) for name, type_ in fields.items()))


_POINT = _type(x=F32, y=F64)
_INNER = _type(numbers=List(I32), texts=List(String()), points=List(_POINT))
_NAMED = _type(name=String(), x=F64)
_LINE = _type(points=List(_NAMED), ids=List(I64), triple=List(U8, 3))

TO_ROS: list[tuple[str, FieldMap, MessageType, str]] = [
    ("scalars", AUTO, _type(i32=I32, s32=I32, sf32=I32, u32=U32, f32=U32, i64=I64, s64=I64, sf64=I64, u64=U64, f64=U64,
                            single=F32, real=F64, flag=Bool(), text=String(), data=List(U8)), ""),
    ("scalars", field_map(a="i32 // 7 + i64 % -3", b="round(real * single)", c="source + text + str(u64)",
                          d="hypot(real, single) ** 2", e="clamp(round(real), -5, 5)",
                          f="clamp(len(text) - len(data), -9, 9)", g='text if flag and text < "m" else source'),
     _type(a=I64, b=I64, c=String(), d=F64, e=I32, f=I32, g=String()), 'flag or real > 0.5 or text == "a"'),
    ("scalars", field_map(a="i32 // s32 + i64 % u32", b="real / single", c="sqrt(real) + sin(single)"),
     _type(a=I64, b=F64, c=F64), "s32 != 0 and not (u32 < 2)"),
    ("scalars", field_map(a="wrap(i32, -7, 9)", b="abs(real) % 1.5 + min(single, 2.0) // 0.25",
                          c="clamp(floor(real), -9, 9) + clamp(ceil(single), 0, 7)",
                          d="atan2(real, single) - max(real, -single)", e="degrees(single)"),
     _type(a=I32, b=F64, c=I64, d=F64, e=F64), ""),
    ("optional", AUTO, _type(number=I32, single=F32, flag=Bool(), text=String(), data=List(U8), point=_POINT), ""),
    ("many", AUTO, _type(numbers=List(I64), singles=List(F32), texts=List(String()), flags=List(Bool()),
                         points=List(_POINT), many=List(_INNER)), ""),
    ("many", field_map(a="numbers[0] + len(points)", b="points[0].x", c="texts[0] + texts[0]"),
     _type(a=I64, b=F64, c=String()), "len(many) < 3"),
    ("choice", AUTO, _type(number=I32, point=_POINT, text=String(), flag=Bool()), ""),
    ("choice", field_map(a="number", b="text"), _type(a=I32, b=String()), ""),
    ("stamped", field_map(a="stamp.seconds", b="stamp.nanos"), _type(a=I64, b=I32), ""),
    ("bounded", AUTO, _type(text=String(), data=List(U8), few=List(I32), two=List(_POINT)), ""),
    ("names", AUTO, _type(self=I32, it=_POINT), ""),
]  # fmt: skip
"""Payload case, mapping, target and condition of each program."""

FROM_ROS: list[tuple[str, FieldMap, MessageType, str, str]] = [
    ("scalars", AUTO, _type(i32=I32, s32=I32, u32=U8, i64=I64, f64=Int(64, False), single=F32, real=F64, flag=Bool(),
                            text=String(), data=List(U8), rock=U8), "", ""),
    ("optional", AUTO, _type(number=I32, text=String(), data=List(U8, 5), point=_type(x=F32, y=F32)), "number > 2", ""),
    ("many", AUTO, _type(numbers=List(I32), singles=List(F32, 3), flags=List(Bool()), rocks=List(I16)), "", ""),
    ("bounded", AUTO, _type(text=String(), data=List(U8), few=List(I32)), "", ""),
    ("scalars", field_map(single="float32(last)", i32="-1"),
     _type(texts=List(String()), wide=String(wide=True), lines=List(_LINE), spans=List(_type(a=U8, b=F64)), last=F64),
     "", ""),
    ("scalars", field_map(i32="round(clamp(100 * (item.x - item.y), -100, 100))", text="item.name + str(index)",
                          u32="count"),
     _type(points=List(_type(name=String(), x=F64, y=F64))), "item.x < item.y", "points"),
    ("scalars", field_map(i64="item", u32="index"), _type(ids=List(I32)), "item not in ids", "ids"),
]  # fmt: skip
"""Payload case, mapping, source, condition and `for_each` of each program."""


def lowered_programs() -> Iterator[Fuzzed]:
    noise = random.Random(1)
    for table in (ROUTES / "rover.yaml", ROUTES / "legacy.yaml", BENCHMARKS / "own.yaml"):
        made = check_table(table, {}).program
        assert made is not None, table
        makers = {name: _seeds_of(made.envelopes.first, name, noise) for name in made.envelopes.first.cases}
        by_route = {handler.route: name for name, handlers in made.inbound.items() for handler in handlers}
        yield from _of(made.lowered, lambda route: makers[by_route[route]], noise)  # noqa: B023 - used at once
    schema, envelope = made_wire()
    for name, fields, target, when in TO_ROS:
        case = envelope.cases[name]
        scope = Scope(case.type, tuple(schema.enums.values()), ())
        checked = Target(
            Topic(Located("topic", SPAN), SPAN), None, target, _when(when, scope), _plan(fields, target, scope)
        )
        route = CheckedRoute(_route(), case, (checked,))
        yield from _of(_lowered(route), lambda _: _seeds_of(envelope, name, noise), noise)  # noqa: B023
    for name, fields, source, when, for_each in FROM_ROS:
        case = envelope.cases[name]
        scope = Scope(source, tuple(schema.enums.values()), ())
        elements = check(written(for_each), scope) if for_each else None
        if elements is not None:
            scope = Scope(source, tuple(schema.enums.values()), (), _names(elements))
        plan = _plan(fields, case.type, scope, scope.names.get(ITEM))
        board = Target(Destination(Located("board", SPAN), SPAN), plan=plan, when=_when(when, scope))
        feed = CheckedSubscription(Topic(Located("topic", SPAN), SPAN), source, None, elements, None, (board,))
        route = CheckedRoute(_route(), case, subscriptions=(feed,))
        yield from _of(_lowered(route), lambda _: _no_seeds, noise, source)


def _no_seeds() -> tuple[bytes, bytes]:
    return b"", b""


def _route() -> Any:
    return SimpleNamespace(name="route", ttl=None, ignore=None, span=SPAN)


def _when(when: str, scope: Scope) -> Node | None:
    return check(written(when), scope) if when else None


def _plan(fields: FieldMap, target: MessageType, scope: Scope, whole: Node | None = None) -> Any:
    mapping = build(fields, target, scope, SPAN, whole)
    assert mapping.findings == [], mapping.findings
    return mapping.plan


def _names(elements: Node) -> dict[str, Node]:
    assert isinstance(elements.kind, ListKind)
    assert elements.kind.element is not None
    names: dict[str, Node] = {name: Variable(UINT32, SPAN, name) for name in (INDEX, COUNT)}
    return {ITEM: Variable(elements.kind.element, SPAN, ITEM), **names}


def _lowered(route: CheckedRoute) -> Lowered:
    lowered, findings = lower_table([route])
    assert findings == [], findings
    return lowered


def _of(
    lowered: Lowered, seeds: Callable[[str], Seeds], noise: random.Random, source: MessageType | None = None
) -> Iterator[Fuzzed]:
    for routes in (lowered.to_destinations, lowered.to_topics):
        for name, route in routes.items():
            for target in route.targets.values():
                yield Fuzzed(_program(route, target), seeds(name))
    for feeds in lowered.from_ros.values():
        for feed in feeds:
            for target in feed.targets.values():
                made = _no_seeds if source is None else lambda: (serialize(source, _values(source, noise)), b"")
                yield Fuzzed(_program(feed, target), made)


def _seeds_of(envelope: Any, name: str, noise: random.Random) -> Seeds:
    payload = Maker(envelope.cases[name].message_class.DESCRIPTOR, noise)
    return lambda: (payload.message(), delimited(1, payload.message()) + delimited(1, payload.message()))


def _values(declared: Type, noise: random.Random) -> Any:
    match declared:
        case MessageType():
            return {field.name: _values(field.type, noise) for field in declared.fields}
        case List():
            length = declared.length if declared.length is not None else noise.randrange(4)
            return [_values(declared.element, noise) for _ in range(length)]
        case String():
            return "".join(noise.choices("aä€😀", k=noise.randrange(4)))
        case Bool():
            return bool(noise.randrange(2))
        case Int():
            return noise.choice([0, 1, declared.low, declared.high, noise.randint(declared.low, declared.high)])
        case _:
            return noise.choice([0.0, -0.0, 1.5, float("nan"), float("inf")])


# ---- as the assembler has them


def _program(route: LoweredRoute | LoweredFeed, target: Target) -> Program:
    for_each = None
    if isinstance(route, LoweredFeed) and route.for_each is not None:
        each = route.for_each
        for_each = ForEach(_routine(each.routine), each.scalar, each.section, each.item)
    return Program(_layout(route), _routine(target.condition), _routine(target.message), for_each)


def _routine(routine: Routine) -> list[evaluating.Operation]:
    return [
        evaluating.Operation(
            f"OP_{kind.name}", slot if isinstance(slot, int) else slot.index, flag, size, number, data or None
        )
        for kind, slot, flag, size, number, data in routine
    ]


def _layout(route: LoweredRoute | LoweredFeed) -> evaluating.Layout:
    made = route.layout
    sections = [
        evaluating.Section([_read(read) for read in section.reads], section.first_slot, section.slot_count)
        for section in made.sections
    ]
    defaults = {index: value for index, value in enumerate(made.defaults) if value is not None}
    return evaluating.Layout(sections, len(made.defaults), made.closed, made.is_cdr, defaults)


def _read(read: Any) -> evaluating.WantedField | evaluating.Step:
    if hasattr(read, "kind"):
        return evaluating.Step(
            f"READ_{read.kind.name}", read.slot, read.size, f"SCALAR_{_scalar(read.type)}", read.elements
        )
    cleared = read.cleared, read.cleared_count
    return evaluating.WantedField(read.number, f"TYPE_{read.type.name}", read.slot, read.is_repeated, read.presence,
                                read.section, read.choice, cleared, read.closed)  # fmt: skip


def _scalar(scalar: Any) -> str:
    return "BOOL" if not hasattr(scalar, "name") or scalar.name == "IN_CELLS" else scalar.name
