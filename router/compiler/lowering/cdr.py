"""Lowers the plan of a ROS message to the operations that write it as CDR."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import starmap

from router.compiler.cdr import HEADER, NO_FIELDS, known_default, known_length, known_value
from router.compiler.expressions.tree import Variable
from router.compiler.lowering.expressions import Lowering
from router.compiler.lowering.lists import LoopList
from router.compiler.lowering.messages import Place, Placed, at, loop, lower_lists, merged
from router.compiler.lowering.numbers import to_real
from router.compiler.lowering.offsets import HIGHEST, Offset
from router.compiler.lowering.operations import Operation, known, load, store
from router.compiler.lowering.sections import size_of
from router.compiler.plan import Each, Items, Leaf, Plan, Record, Unset
from router.declared import Op, Scalar
from router.types.model import Float, Int, String


def cdr_message(lowering: Lowering, plan: Record) -> list[Placed]:
    """Return the operations that write a message, each with its place."""
    header = known(HEADER), Place(plan.span, "")
    placed = [header, *_Writer(lowering).plan(plan, "")]
    return list(merged(_padded(placed, Offset(HIGHEST, -len(HEADER) % HIGHEST))))


@dataclass(frozen=True, slots=True)
class _Writer:
    lowering: Lowering

    def plan(self, plan: Plan, path: str) -> Iterator[Placed]:
        place = Place(plan.span, path)
        match plan:
            case Record():
                for member, inner in plan.members:
                    yield from self.plan(inner, f"{path}.{member.name}" if path else member.name)
                if not plan.type.fields:
                    yield from at(place, known(*NO_FIELDS))
            case Unset():
                yield from at(place, *starmap(known, known_default(plan.type, plan.default)))
            case Leaf():
                yield from self._leaf(plan, place)
            case Items():
                if plan.type.length is None:
                    yield from at(place, known(*known_length(len(plan.items))))
                for item in plan.items:
                    yield from self.plan(item, path)
            case Each():
                yield from self._each(plan, place)

    def _leaf(self, leaf: Leaf, place: Place) -> list[Placed]:
        if leaf.constant is not None:
            return at(place, known(*known_value(leaf.constant, leaf.type)))
        value = self.lowering.value(leaf.node)
        match leaf.type:
            case String():
                return at(place, value, Operation(Op.PUT_TEXT))
            case Float(bits):
                put = Op.PUT_FLOAT if bits == 32 else Op.PUT_DOUBLE
                return at(place, to_real(value, leaf.node.kind), Operation(put))
            case _:
                return at(place, value, Operation(Op.PUT, size_of(leaf.type)))

    def _each(self, plan: Each, place: Place) -> list[Placed]:
        count, inputs = lower_lists(self.lowering, plan)
        slot = self.lowering.names.temporary()
        number = at(place, count)
        if plan.type.length is None:
            number += at(place, store(slot), Operation(Op.PUT, 4), load(slot))
        if _are_copied(plan, inputs):
            (_, _, octets), *_ = inputs
            return [*number, *at(place, Operation(Op.DROP), load(octets), Operation(Op.PUT_BYTES))]
        body = loop(
            self.lowering,
            inputs,
            place,
            lambda: list(merged(_padded(self.plan(plan.element, place.field), Offset()))),
        )
        return [*number, *body]


def _are_copied(plan: Each, inputs: list[LoopList]) -> bool:
    """Return whether bytes are copied to a list of bytes unchanged."""
    element = plan.element
    if len(inputs) > 1 or not isinstance(element, Leaf) or element.type != Int(8, signed=False):
        return False
    variable, of, _ = inputs[0]
    return of.scalar is Scalar.UINT8 and isinstance(element.node, Variable) and element.node.name == variable


# ---- known bytes


_SIZES = {Op.PUT_FLOAT: 4, Op.PUT_DOUBLE: 8}
_LOSE = frozenset({Op.PUT_TEXT, Op.PUT_BYTES, Op.REPEAT, Op.AGAIN})
"""Operations after which the offset is not known."""


def _padded(placed: Iterable[Placed], offset: Offset) -> Iterator[Placed]:
    """Prepend known padding to known bytes, which then need no alignment. The first operation writes at `offset`."""
    for operation, place in placed:
        if operation.kind is not Op.KNOWN:
            yield operation, place
            _advance(offset, operation)
            continue
        alignment = int(operation.slot)  # type: ignore[arg-type]
        padding = offset.padding(alignment)
        offset.advance(alignment, operation.size)
        yield (operation if padding is None else known(bytes(padding) + operation.data)), place


def _advance(offset: Offset, operation: Operation) -> None:
    if operation.kind in _LOSE:
        offset.lose()
    elif operation.kind is Op.PUT:
        offset.advance(int(operation.slot), int(operation.slot))  # type: ignore[arg-type]
    elif operation.kind in _SIZES:
        offset.advance(_SIZES[operation.kind], _SIZES[operation.kind])
