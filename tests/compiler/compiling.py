"""The compiler's real path in small: one expression, one mapping, one handler, ready to be called."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any

from router.compiler.cdr import write_message
from router.compiler.expressions import Scope, check
from router.compiler.expressions.tree import Node
from router.compiler.mapping import build
from router.compiler.namespace import MAPPING_FAILURES, NAMESPACE
from router.compiler.program import Handler, Program
from router.compiler.python import render
from router.compiler.source import Source
from router.errors import Diagnostic, Located, SourceSpan
from router.rehearsal.cdr import serialize as cdr
from router.table.model import Choices, Expression, FieldEntry, FieldMap
from router.table.nodes import TextPlace
from router.types.model import Enum, MessageType, Type
from tests.oracles.python_engine.binding import bind
from tests.oracles.python_engine.freshness import Born, Freshness
from tests.oracles.python_engine.rig import Rig
from tests.oracles.reference import fill
from tests.oracles.reference_expressions import Context
from tests.oracles.reference_kinds import View

SPAN = SourceSpan("table.yaml", 7, 3, 9)
RECEIVED_AT = 1_700_000_000_123_456_789
SOURCE = "sensor_board"

Handle = Callable[[Any, bytes, int, int, str], None]


def written(text: str) -> Expression:
    """An expression that stands in line 7 of a table, from column 3."""
    span = SourceSpan("table.yaml", 7, 3, 3 + len(text))
    return Expression(text, TextPlace(span, ((0, span),)))


def chosen(subject: str, values: Mapping[str, str], otherwise: str | None = None) -> Expression:
    """The expression `{map: subject, **values, else: otherwise}`."""
    listed = tuple((Located(name, SPAN), written(text)) for name, text in values.items())
    choices = Choices(written(subject), listed, None if otherwise is None else written(otherwise))
    return Expression("", TextPlace(SPAN), choices=choices)


def field_map(auto: bool = False, /, **entries: str | Expression) -> FieldMap:
    """`header__stamp="received_at"` is the entry `header.stamp: received_at`."""
    paths = {tuple(name.split("__")): value for name, value in entries.items()}
    values = {path: written(value) if isinstance(value, str) else value for path, value in paths.items()}
    return FieldMap(SPAN, auto, tuple(FieldEntry(path, (SPAN,) * len(path), value) for path, value in values.items()))


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
    """A checked expression, and as a function of the message. Raises ExpressionError."""
    node = check(written(expression) if isinstance(expression, str) else expression, scope, expected)
    out = Source()
    with out.block("def evaluate(m, source, received_at):", SPAN):
        out.line(f"return {out.expression(render(node))}", SPAN)
    namespace: dict[str, Any] = dict(NAMESPACE)
    exec(out.compile("table.yaml"), namespace)  # noqa: S102 - what is tested
    return node, lambda message: namespace["evaluate"](message, SOURCE, RECEIVED_AT)


def serializer(fields: FieldMap, target: MessageType, scope: Scope) -> Callable[[Any], bytes]:
    """A function from a message to the CDR bytes of the topic that `fields` fills."""
    mapping = build(fields, target, scope, SPAN)
    assert mapping.findings == []
    out = Source()
    with out.block("def serialize(m, source, received_at):", SPAN):
        out.line(f"return {write_message(out, mapping.plan, 'it')}", SPAN)
    namespace: dict[str, Any] = {**NAMESPACE, **out.constants}
    exec(out.compile("table.yaml"), namespace)  # noqa: S102 - what is tested
    return lambda message: bytes(namespace["serialize"](message, SOURCE, RECEIVED_AT))


def findings_of(fields: FieldMap, target: MessageType, scope: Scope) -> list[Diagnostic]:
    return build(fields, target, scope, SPAN).findings


def reference_bytes(fields: FieldMap, target: MessageType, context: Context, padding: int = 0) -> bytes:
    return cdr(target, fill(fields, target, context), padding)


def outcome(make: Callable[[], Any]) -> Any:
    """What `make` gives, or the class of the failure: every one that the engine counts is equal here."""
    try:
        return make()
    except MAPPING_FAILURES:
        return MAPPING_FAILURES


DATAGRAM = b"\x18\x01"
"""What stands for the datagram of any message: an envelope with a field that nobody knows."""


class Published:
    """A handler of a program, whose targets are those of a rig: `reports` has its losses, `sent` what it sends."""

    def __init__(self, program: Program, handler: Handler) -> None:
        rig = Rig(program)
        self.topics = {target.label for target in handler.targets if target.is_topic}
        self.reports, self.sent, self._published = rig.reports, rig.sent, rig.published
        self._is_aged = handler.ttl is not None
        self._handle = bind(program, handler, rig.context, Freshness())

    def __call__(self, message: Any) -> dict[str, bytes]:
        """Serve one message, and return what is published by topic. Topics whose mapping failed are left out."""
        for made in (self.reports, self.sent, self._published):
            made.clear()
        self._handle(message, DATAGRAM, RECEIVED_AT, 1, SOURCE, *((Born(1, 1),) if self._is_aged else ()))
        return dict(self._published)
