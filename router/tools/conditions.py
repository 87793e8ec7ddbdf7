"""What somebody wants to see of payloads, as an expression of the table's language: `accel_z > 9 and source == 'x'`.

Knows payload cases; not where payloads come from.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import cast

from google.protobuf.message import Message

from router.compiler.expressions import ExpressionError, ParsedReads, Scope, check
from router.compiler.expressions.kinds import BoolKind
from router.compiler.namespace import NAMESPACE
from router.compiler.source import Source
from router.engine.delivery import MAPPING_FAILURES
from router.errors import Code, Diagnostic, SourceSpan, UsageError
from router.table.model import Expression
from router.table.nodes import TextPlace
from router.types.model import Enum, List, MessageType, Type
from router.types.protobuf import PayloadCase

Holds = Callable[[Message, str, int], bool]
"""Whether a condition holds for a payload, from whom, received when (wall clock, ns)."""

FUNCTION = "holds"


class Condition:
    """One expression for several payload cases; it may be about fields that not all of them have.

    `failure` is the first value that it could not be asked for, as in a division by zero: there it does not hold.
    """

    def __init__(self, text: str, cases: Sequence[PayloadCase]) -> None:
        """Raises UsageError where it suits none of the cases."""
        self.failure = ""
        self._holds: dict[str, Holds] = {}
        findings: dict[str, Diagnostic] = {}
        for case in cases:
            try:
                self._holds[case.name] = _compiled(text, case.type)
            except ExpressionError as error:
                findings[case.name] = error.diagnostic
        if not self._holds:
            likely = min(findings.values(), key=lambda each: not each.hint.startswith("did you mean"))
            raise UsageError(f"--where: {likely.message}" + (f"; {likely.hint}" if likely.hint else ""))

    @property
    def cases(self) -> frozenset[str]:
        """Those that it can be asked of."""
        return frozenset(self._holds)

    def holds(self, case: str, payload: Message, source: str, received_at: int) -> bool:
        try:
            return case in self._holds and self._holds[case](payload, source, received_at)
        except MAPPING_FAILURES as error:
            self.failure = self.failure or f"{case}: {error}"
            return False


def _compiled(text: str, message: MessageType) -> Holds:
    """Raises ExpressionError."""
    span = SourceSpan("--where", 1, 1, len(text) + 1)
    reads = ParsedReads()
    place = TextPlace(span, ((0, span),))
    typed = check(Expression(text, place), Scope(message, tuple(_enums(message)), (), reads))
    if not isinstance(typed.kind, BoolKind):
        raise ExpressionError(
            span, Code.TYPE_MISMATCH, f"it is {typed.kind}, not a bool", "compare something, as in speed > 0"
        )
    out = Source()
    with out.block(f"def {FUNCTION}(m, source, received_at):", span):
        reads.write(out, span)
        out.line(f"return {out.expression(typed.node)}", span)
    names: dict[str, object] = {**NAMESPACE}
    exec(out.compile("--where"), names)  # noqa: S102 - of checked expressions, as in handlers
    return cast("Holds", names[FUNCTION])


def _enums(message: MessageType) -> Iterator[Enum]:
    """All that the fields of a message, and of what is in it, can be; each once."""
    waiting: list[Type] = [message]
    found: dict[str, Type] = {}
    while waiting:
        current = waiting.pop()
        if isinstance(current, List):
            waiting.append(current.element)
        elif isinstance(current, (Enum, MessageType)) and current.name not in found:
            found[current.name] = current
            if isinstance(current, MessageType):
                waiting += [member.type for member in current.fields]
    return (each for each in found.values() if isinstance(each, Enum))
