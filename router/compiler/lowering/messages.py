"""Common parts of the writers of both kinds of messages: operations with their places, and lists that fill fields."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

from router.compiler.lowering import lists
from router.compiler.lowering.expressions import Lowering
from router.compiler.lowering.lists import LoopList
from router.compiler.lowering.operations import Operation, Routine, known, repeat, routine
from router.compiler.plan import Each
from router.declared import Op
from router.errors import SourceSpan
from router.types.model import List


class Place(NamedTuple):
    """The field that an operation fills, and the position of its mapping in the table."""

    span: SourceSpan
    field: str

    def __str__(self) -> str:
        return f"{self.span}: {self.field}" if self.field else str(self.span)


Placed = tuple[Operation, Place]


def at(place: Place, *parts: Operation | Routine) -> list[Placed]:
    return [(operation, place) for operation in routine(*parts)]


def merged(placed: Iterable[Placed]) -> Iterator[Placed]:
    """Join known bytes with following ones that need no padding. They have the place of the first bytes."""
    last: Placed | None = None
    for operation, place in placed:
        if last is not None and operation.kind is Op.KNOWN and operation.slot == 1:
            before, first = last
            last = known(before.data + operation.data, int(before.slot)), first  # type: ignore[arg-type]
            continue
        if last is not None:
            yield last
            last = None
        if operation.kind is Op.KNOWN:
            last = operation, place
        else:
            yield operation, place
    if last is not None:
        yield last


def lower_lists(lowering: Lowering, plan: Each) -> tuple[Routine, list[LoopList]]:
    """Lower the lists that fill a field, as `lists.lower_lists`. A length that the field cannot hold is rejected."""
    count, inputs = lists.lower_lists(lowering, plan.lists)
    declared = plan.type
    assert isinstance(declared, List)  # noqa: S101 - an Each fills one
    if declared.length is not None:
        return routine(count, Operation(Op.FIT_COUNT, number=declared.length)), inputs
    if declared.bound is not None:
        return routine(count, Operation(Op.FIT_COUNT, flag=True, number=declared.bound)), inputs
    return count, inputs


def loop(lowering: Lowering, inputs: list[LoopList], place: Place, body: Callable[[], list[Placed]]) -> list[Placed]:
    """Return a loop over `body`; the number of iterations is on the stack. `place` is that of the loop itself."""
    placed: list[Placed] = []

    def lowered() -> Routine:
        placed.extend(body())
        return tuple(operation for operation, _ in placed)

    before, turn = lists.loop_body(lowering, inputs, lowered)
    front = len(turn) - len(placed)
    places = [place] * front + [own for _, own in placed]
    opening, *_, closing = repeat(turn)
    return [*at(place, before), (opening, place), *zip(turn, places, strict=True), (closing, place)]
