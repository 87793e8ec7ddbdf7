"""From the plan of a ROS message to the operations that write it as CDR: the same steps of which code is generated."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TypeVar

from router.compiler.cdr.writing import Blob, Put, Repeat, Step, Text, steps
from router.compiler.lowering.expressions import Listed, Lowering, fit, type_of
from router.compiler.lowering.operations import MOST_LOOPS, Code, Op, Operation, Slot
from router.compiler.lowering.values import Integer, NeedsPython, Octets, integer, to_real
from router.compiler.plan import Plan, Record
from router.errors import SourceSpan
from router.types.model import List

P = TypeVar("P")

_INTEGERS = {
    "b": (-(1 << 7), (1 << 7) - 1), "B": (0, (1 << 8) - 1),
    "h": (-(1 << 15), (1 << 15) - 1), "H": (0, (1 << 16) - 1),
    "i": (-(1 << 31), (1 << 31) - 1), "I": (0, (1 << 32) - 1),
    "q": (-(1 << 63), (1 << 63) - 1), "Q": (0, (1 << 64) - 1),
}  # fmt: skip
"""By format of `struct`: what fits."""


class Unlowered(Exception):
    """Which field of a message needs Python, why, and where the table says what fills it."""

    def __init__(self, field: str, reason: str, span: SourceSpan) -> None:
        super().__init__(f"`{field}` needs it: {reason}")
        self.span = span


Placed = tuple[Operation, SourceSpan | None]
"""An operation, and where the table says what it does; None for known bytes."""


@dataclass(frozen=True, slots=True)
class MessageWriter:
    """Writes the message of a target. `rows` are the expressions by path of their field."""

    lowering: Lowering
    rows: Mapping[str, str]

    def message(self, plan: Record) -> list[tuple[Operation, str]]:
        """Return the operations, each with the position and the field that it is for. Raises Unlowered."""
        return list(_merged(self._record(plan, ())))

    def _record(self, plan: Record, path: tuple[str, ...]) -> Iterator[tuple[Operation, str]]:
        for member, made in plan.members:
            inner = (*path, member.name)
            if isinstance(made, Record) and made.type.fields:
                yield from self._record(made, inner)
            else:
                yield from self._field(made, inner)
        if not plan.type.fields:
            yield from self._placed(plan, path)

    def _field(self, made: Plan, path: tuple[str, ...]) -> Iterator[tuple[Operation, str]]:
        try:
            yield from list(self._placed(made, path))
        except NeedsPython as reason:
            raise Unlowered(self._shown(path), str(reason), made.span) from None

    def _placed(self, made: Plan, path: tuple[str, ...]) -> Iterator[tuple[Operation, str]]:
        field = ".".join(path)
        for operation, span in self._steps(steps(made), 0):
            yield operation, f"{span or made.span}: {field}"

    def _shown(self, path: tuple[str, ...]) -> str:
        """The field with its expression, which may be that of the message around it."""
        names = [".".join(path[:length]) for length in range(len(path), 0, -1)]
        return next((f"{name}: {self.rows[name]}" for name in names if name in self.rows), names[0])

    def _steps(self, sequence: Iterable[Step], depth: int) -> Iterator[Placed]:
        for step in sequence:
            match step:
                case Blob():
                    yield _known(step.data, step.alignment), None
                case Put():
                    yield from _at(step.span, self._put(step))
                case Text(wide=True):
                    raise NeedsPython("the carrier writes no wide strings")
                case Text():
                    yield from _at(step.span, self.lowering.value(step.node).then(Op.PUT_TEXT).code)
                case Repeat():
                    yield from self._repeat(step, depth)

    def _put(self, step: Put) -> Code:
        value = self.lowering.value(step.node)
        if step.format == "?":
            return value.then(Op.PUT, slot=1).code
        if step.format in _INTEGERS:
            low, high = _INTEGERS[step.format]
            return fit(value, integer(low), integer(high)).then(Op.PUT, slot=step.size).code
        return to_real(value).then(Op.PUT_FLOAT if step.format == "f" else Op.PUT_DOUBLE).code

    def _repeat(self, step: Repeat, depth: int) -> Iterator[Placed]:
        if depth == MOST_LOOPS:
            raise NeedsPython("it has lists in too many lists")
        listed = self.lowering.listed(step.values)
        yield from _at(step.span, (*listed.code, *_count(listed.slot, step.type)))
        if listed.is_octets and _copies_octets(step):
            yield from _at(step.span, (Operation(Op.LOAD, listed.slot), Operation(Op.PUT_BYTES)))
            return
        element = _at(step.span, self._element(step.variable, listed))
        body = [*element, *_merged(self._steps(step.body, depth + 1))]
        each = Op.EACH_BYTE if listed.is_octets else Op.EACH
        yield Operation(each, listed.slot, size=len(body) + 1), step.span
        yield from body
        yield Operation(Op.AGAIN), step.span

    def _element(self, variable: str, listed: Listed) -> Code:
        """What makes the element on the stack be `variable`."""
        names = self.lowering.names
        if listed.field.message_type is not None:
            names.messages[variable] = node = names.element(listed.field)
            return (Operation(Op.ENTER, node),)
        slot = names.temporary()
        kind = type_of(listed.field)
        names.values[variable] = slot, Integer(0, 255) if isinstance(kind, Octets) and listed.is_octets else kind
        return Operation(Op.KEEP, slot), Operation(Op.DROP)


def _at(span: SourceSpan, code: Code) -> Iterator[Placed]:
    return ((operation, span) for operation in code)


def _known(data: bytes, alignment: int) -> Operation:
    return Operation(Op.KNOWN, alignment, size=len(data), data=data)


def _count(slot: Slot, declared: List) -> Code:
    """The number of elements: checked, and written where the list is no array."""
    least, most = (declared.length, declared.length) if declared.length is not None else (0, declared.bound)
    if most is not None:
        bounds = (*integer(least).code, *integer(most).code)
        checked: Code = (*bounds, Operation(Op.WANT_COUNT, slot))
    else:
        checked = ()
    if declared.length is not None:
        return checked
    return (*checked, Operation(Op.COUNT, slot), Operation(Op.PUT, 4))


def _copies_octets(step: Repeat) -> bool:
    match step.body:
        case [Put("B", ast.Name(name))]:
            return name == step.variable
    return False


def _merged(placed: Iterable[tuple[Operation, P]]) -> Iterator[tuple[Operation, P]]:
    """Known bytes that stand beside each other as one, where the padding between them does not depend on the offset."""
    last: tuple[Operation, P] | None = None
    for operation, place in placed:
        if last is None or not _follows(last[0], operation):
            if last is not None:
                yield last
            last = operation, place
            continue
        before, first = last
        padding = bytes(-before.size % operation.slot)  # type: ignore[operator]  # an alignment
        data = before.data + padding + operation.data
        last = before._replace(data=data, size=len(data)), first
    if last is not None:
        yield last


def _follows(last: Operation, operation: Operation) -> bool:
    if last.kind is not Op.KNOWN or operation.kind is not Op.KNOWN:
        return False
    return int(operation.slot) <= int(last.slot)  # type: ignore[arg-type]  # alignments
