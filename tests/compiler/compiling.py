"""The compiler's real path for one expression or one mapping, as a function."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any

from router.compiler.expressions import Scope, check
from router.compiler.expressions.kinds import (
    BoolKind,
    BytesKind,
    EnumKind,
    FloatKind,
    IntKind,
    Kind,
    ListKind,
    StringKind,
    TimeKind,
    element_of,
)
from router.compiler.expressions.tree import Each as Computed
from router.compiler.expressions.tree import ListLiteral, Node, Variable
from router.compiler.mapping import build
from router.compiler.plan import Each, Items, Leaf, Record
from router.errors import Diagnostic, Located, SourceSpan
from router.rehearsal.cdr import deserialize
from router.rehearsal.cdr import serialize as cdr
from router.table.model.expressions import Choices, Elements, Expression, FieldEntry, FieldMap
from router.table.nodes import TextSpan
from router.types.model import Bool, Enum, Field, Float, Int, List, MessageType, String, Type
from tests.compiler.machine import FAILURES, machine
from tests.oracles.reference import fill
from tests.oracles.reference_expressions import Context
from tests.oracles.reference_kinds import View

SPAN = SourceSpan("table.yaml", 7, 3, 9)
RECEIVED_AT = 1_700_000_000_123_456_789
SOURCE = "sensor_board"


def written(text: str) -> Expression:
    """An expression at line 7, column 3 of a table."""
    span = SourceSpan("table.yaml", 7, 3, 3 + len(text))
    return Expression(text, TextSpan(span, ((0, span),)))


def chosen(subject: str, values: Mapping[str, str], otherwise: str | None = None) -> Expression:
    """The expression `{map: subject, **values, else: otherwise}`."""
    listed = tuple((Located(name, SPAN), written(text)) for name, text in values.items())
    choices = Choices(written(subject), listed, None if otherwise is None else written(otherwise))
    return Expression("", TextSpan(SPAN), choices=choices)


def field_map(auto: bool = False, /, **entries: str | Expression | Elements) -> FieldMap:
    """`header__stamp="received_at"` is the entry `header.stamp: received_at`."""
    paths = {tuple(name.split("__")): value for name, value in entries.items()}
    values = {path: written(value) if isinstance(value, str) else value for path, value in paths.items()}
    return FieldMap(SPAN, auto, tuple(FieldEntry(path, (SPAN,) * len(path), value) for path, value in values.items()))


def listed(*elements: FieldMap) -> Expression:
    """The expression `[{x: 1}, {y: 2}]`, a list of messages."""
    return Expression("", TextSpan(SPAN), tuple(Expression("", TextSpan(SPAN), fields=fields) for fields in elements))


def each(source: str, fields: FieldMap) -> Elements:
    """`{each: source, fields: fields}`."""
    return Elements(written(source), fields)


AUTO = field_map(True)


def scope_of(message: MessageType, enums: Collection[Enum] = (), ros_types: Collection[MessageType] = ()) -> Scope:
    return Scope(message, enums, ros_types)


def context_of(
    message: Any, declared: MessageType, enums: Collection[Enum] = (), ros_types: Collection[MessageType] = ()
) -> Context:
    return Context(View(message, declared), SOURCE, RECEIVED_AT, enums, ros_types)


def compiled(
    expression: str | Expression, scope: Scope, expected: Type | None = None
) -> tuple[Node, Callable[[Any], Any]]:
    """A checked expression, and a function that evaluates it for a message. Raises ExpressionError."""
    node = check(written(expression) if isinstance(expression, str) else expression, scope, expected)
    return node, lambda message: _evaluator(node, scope)(message)  # noqa: PLW0108 - most are not run


def _evaluator(node: Node, scope: Scope) -> Callable[[Any], Any]:
    planned = _planned(node)
    target = MessageType("made/msg/It", (Field("it", planned.type),))
    make = machine(Record(target, ((target.fields[0], planned),), SPAN), scope.message, target, RECEIVED_AT, SOURCE)

    def evaluate(message: Any) -> Any:
        made = deserialize(target, make(message)).it
        return bytes(made) if isinstance(node.kind, BytesKind) else made

    return evaluate


def _planned(node: Node) -> Leaf | Items | Each:
    """A field that an expression fills without conversion."""
    element = element_of(node.kind)
    if element is None and not isinstance(node.kind, ListKind):
        return Leaf(_type_of(node.kind), node, SPAN)
    declared = List(_type_of(element) if element is not None else Float(64))
    if isinstance(node, ListLiteral):
        return Items(declared, tuple(Leaf(declared.element, item, SPAN) for item in node.items), SPAN)
    assert element is not None
    if isinstance(node, Computed):
        return Each(declared, node.lists, Leaf(declared.element, node.element, SPAN), SPAN)
    variable = Variable(element, SPAN, "an element")
    return Each(declared, ((variable.name, node),), Leaf(declared.element, variable, SPAN), SPAN)


def _type_of(kind: Kind) -> Type:
    match kind:
        case BoolKind():
            return Bool()
        case FloatKind():
            return Float(64)
        case StringKind():
            return String()
        case IntKind(high=high):
            return Int(64, signed=high < 1 << 63)
        case EnumKind() | TimeKind():
            return Int(64, signed=True)
        case _:
            raise AssertionError(f"{kind} is no value")


def serializer(fields: FieldMap, target: MessageType, scope: Scope) -> Callable[[Any], bytes]:
    """A function from a message to the CDR bytes that `fields` gives."""
    mapping = build(fields, target, scope, SPAN)
    assert mapping.findings == []
    return machine(mapping.plan, scope.message, target, RECEIVED_AT, SOURCE)


def findings_of(fields: FieldMap, target: MessageType, scope: Scope) -> list[Diagnostic]:
    return build(fields, target, scope, SPAN).findings


def reference_bytes(fields: FieldMap, target: MessageType, context: Context, padding: int = 0) -> bytes:
    return cdr(target, fill(fields, target, context), padding)


def outcome(make: Callable[[], Any]) -> Any:
    """The result of `make`, or the class of its failure. All failures that count as drops are equal here."""
    try:
        return make()
    except FAILURES:
        return FAILURES
