"""From the plan of a ROS message to the operations that write it as CDR."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from router.compiler.cdr.primitives import HEADER, put_text, put_wide_text, scalar_format
from router.compiler.expressions.tree import Variable
from router.compiler.lowering.expressions import Lowering
from router.compiler.lowering.lists import Taken
from router.compiler.lowering.messages import Place, Placed, at, counted, each
from router.compiler.lowering.nodes import size_of
from router.compiler.lowering.numbers import to_real
from router.compiler.lowering.offsets import HIGHEST, Offset
from router.compiler.lowering.operations import Op, Operation, Scalar, keep, known, load
from router.compiler.plan import Each, Items, Leaf, Plan, Record, Unset
from router.types.model import Bool, Float, Int, List, MessageType, String, Type

_EMPTY = b"\0"
"""A message without fields: IDL has none, so rosidl adds the byte `structure_needs_at_least_one_member`."""


def cdr_message(lowering: Lowering, plan: Record) -> list[Placed]:
    """Return the operations that write a message, each with its place."""
    header = known(HEADER), Place(plan.span, "")
    return list(_merged([header, *_Writer(lowering).plan(plan, "")], Offset(HIGHEST, -len(HEADER) % HIGHEST)))


@dataclass(frozen=True, slots=True)
class _Writer:
    lowering: Lowering

    def plan(self, made: Plan, path: str) -> Iterator[Placed]:
        place = Place(made.span, path)
        match made:
            case Record():
                for member, inner in made.members:
                    yield from self.plan(inner, f"{path}.{member.name}" if path else member.name)
                if not made.type.fields:
                    yield from at(place, known(_EMPTY))
            case Unset():
                yield from at(place, *_default(made.type, made.default))
            case Leaf():
                yield from self._leaf(made, place)
            case Items():
                if made.type.length is None:
                    yield from at(place, _number(len(made.items)))
                for item in made.items:
                    yield from self.plan(item, path)
            case Each():
                yield from self._each(made, place)

    def _leaf(self, made: Leaf, place: Place) -> list[Placed]:
        if made.constant is not None:
            return at(place, _known(made.constant, made.type))
        value = self.lowering.value(made.node)
        match made.type:
            case String():
                return at(place, value, Operation(Op.PUT_TEXT))
            case Float(bits):
                put = Op.PUT_FLOAT if bits == 32 else Op.PUT_DOUBLE
                return at(place, to_real(value, made.node.kind), Operation(put))
            case _:
                return at(place, value, Operation(Op.PUT, size_of(made.type)))

    def _each(self, made: Each, place: Place) -> list[Placed]:
        count, taken = counted(self.lowering, made)
        slot = self.lowering.names.temporary()
        number = at(place, count)
        if made.type.length is None:
            number += at(place, keep(slot), Operation(Op.PUT, 4), load(slot))
        if _are_copied(made, taken):
            (_, _, octets), *_ = taken
            return [*number, *at(place, Operation(Op.DROP), load(octets), Operation(Op.PUT_BYTES))]
        body = each(self.lowering, taken, place, lambda: list(_merged(self.plan(made.element, place.field), Offset())))
        return [*number, *body]


def _are_copied(made: Each, taken: list[Taken]) -> bool:
    """Whether bytes become a list of the same bytes."""
    element = made.element
    if len(taken) > 1 or not isinstance(element, Leaf) or element.type != Int(8, signed=False):
        return False
    variable, of, _ = taken[0]
    return of.scalar is Scalar.UINT8 and isinstance(element.node, Variable) and element.node.name == variable


# ---- known bytes


def _known(value: Any, declared: Type) -> Operation:
    """A value of a primitive type."""
    if isinstance(declared, String):
        data = bytearray()
        (put_wide_text if declared.wide else put_text)(data, value)
        return known(bytes(data), 4)
    return known(struct.pack("<" + scalar_format(declared), value), size_of(declared))


def _number(length: int) -> Operation:
    return known(struct.pack("<I", length), 4)


def _default(declared: Type, default: Any) -> Iterator[Operation]:
    """A field that nothing fills: the same value as rclpy's constructor gives it."""
    match declared:
        case MessageType():
            for member in declared.fields:
                yield from _default(member.type, member.default)
            if not declared.fields:
                yield known(_EMPTY)
        case List():
            values = [None] * (declared.length or 0) if default is None else default
            if declared.length is None:
                yield _number(len(values))
            for value in values:
                yield from _default(declared.element, value)
        case _:
            yield _known(_zero(declared) if default is None else default, declared)


def _zero(declared: Type) -> object:
    match declared:
        case Bool():
            return False
        case Float():
            return 0.0
        case String():
            return ""
        case _:
            return 0


_SIZES = {Op.PUT_FLOAT: 4, Op.PUT_DOUBLE: 8}
_LOSE = frozenset({Op.PUT_TEXT, Op.PUT_BYTES, Op.REPEAT, Op.AGAIN})
"""Behind these the offset is not known."""


def _merged(placed: Iterable[Placed], offset: Offset) -> Iterator[Placed]:
    """Join known bytes that stand beside each other. Where the padding is known it becomes known bytes as well."""
    last: Placed | None = None
    for operation, place in placed:
        if operation.kind is not Op.KNOWN:
            if last is not None:
                yield last
                last = None
            yield operation, place
            _advance(offset, operation)
            continue
        alignment = int(operation.slot)  # type: ignore[arg-type]
        padding = offset.padding(alignment)
        offset.advance(alignment, operation.size)
        if last is not None and padding is not None:
            before, place = last[0], last[1]  # noqa: PLW2901 - of the first of them
            last = known(before.data + bytes(padding) + operation.data, int(before.slot)), place  # type: ignore[arg-type]
            continue
        if last is not None:
            yield last
        last = (operation if padding is None else known(bytes(padding) + operation.data)), place
    if last is not None:
        yield last


def _advance(offset: Offset, operation: Operation) -> None:
    if operation.kind in _LOSE:
        offset.lose()
    elif operation.kind is Op.PUT:
        offset.advance(int(operation.slot), int(operation.slot))  # type: ignore[arg-type]
    elif operation.kind in _SIZES:
        offset.advance(_SIZES[operation.kind], _SIZES[operation.kind])
