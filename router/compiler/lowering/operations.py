"""Routines of the operations that `native/operations.h` declares, and static analysis of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Union

from router.declared import MAX_DATAGRAM, Op

if TYPE_CHECKING:
    from router.compiler.lowering.sections import Section


@dataclass(eq=False, slots=True)
class Slot:
    """A place for a value; a layout assigns its `index`. `default` is its value if nothing was read; None for a list.

    `name` describes the value in the words of the table; it is empty for a temporary.
    """

    default: int | float | bytes | None = None
    name: str = ""
    index: int = -1


class Flag(Slot):
    """A slot that tells whether a value has been computed in a loop: see `once`."""

    __slots__ = ()


class Operation(NamedTuple):
    """`struct operation`. `slot` may be an object with an index; `data` is added to the layout's literals."""

    kind: Op
    slot: Union[int, Slot, Section] = 0
    flag: int = 0
    size: int = 0
    number: int | float = 0
    data: bytes = b""


Routine = tuple[Operation, ...]


def routine(*parts: Operation | Routine) -> Routine:
    """Concatenate operations and routines."""
    operations: list[Operation] = []
    for part in parts:
        if isinstance(part, Operation):
            operations.append(part)
        else:
            operations += part
    return tuple(operations)


def integer(number: int) -> Operation:
    return Operation(Op.INTEGER, number=number if number < 1 << 63 else number - (1 << 64))


def real(number: float) -> Operation:
    return Operation(Op.REAL, number=float(number))


def text(data: bytes) -> Operation:
    return Operation(Op.TEXT, size=len(data), data=data)


def known(data: bytes, alignment: int = 1) -> Operation:
    return Operation(Op.KNOWN, alignment, size=len(data), data=data)


def load(slot: Slot) -> Operation:
    return Operation(Op.LOAD, slot)


def store(slot: Slot) -> Operation:
    return Operation(Op.KEEP, slot)


DROP, SIZE = Operation(Op.DROP), Operation(Op.SIZE)


def repeat(body: Routine, *, keeps: bool = False) -> Routine:
    """Return a loop over `body`; the number of iterations is on the stack.

    `keeps`: lists and text that the body makes are used after the loop.
    """
    return (Operation(Op.REPEAT, flag=keeps, size=len(body) + 1), *body, Operation(Op.AGAIN))


def chained(op: Op, routines: Sequence[Routine]) -> Routine:
    """Return a chain of conditions; evaluation stops once the result is known."""
    left, operations = sum(map(len, routines)) + len(routines) - 1, list[Operation]()
    for condition in routines[:-1]:
        left -= len(condition) + 1
        operations += *condition, Operation(op, size=left)
    return (*operations, *routines[-1])


def choice(test: Routine, body: Routine, orelse: Routine) -> Routine:
    """Return operations that push one of two values; the other one is not evaluated."""
    return routine(test, Operation(Op.UNLESS, size=len(body) + 1), body, Operation(Op.JUMP, size=len(orelse)), orelse)


def once(computed: Routine, flag: Flag, kept: Slot) -> Routine:
    """Return `computed` for a loop: it is computed on first use and then kept. `flag` is 0 before the loop."""
    return choice((load(flag),), (load(kept),), routine(computed, store(kept), integer(1), store(flag), DROP))


# ---- static analysis

_GIVE = frozenset({Op.INTEGER, Op.REAL, Op.TEXT, Op.LOAD, Op.NEXT})
_TAKE_ONE = frozenset({
    Op.DROP, Op.UNLESS, Op.AND, Op.OR, Op.SAME_COUNT, Op.ENTER, Op.REPEAT, Op.APPEND, Op.PUT, Op.PUT_FLOAT,
    Op.PUT_DOUBLE, Op.PUT_TEXT, Op.PUT_BYTES, Op.WRITE_VARINT, Op.WRITE_ZIGZAG, Op.WRITE_FIXED32, Op.WRITE_FIXED64,
    Op.WRITE_FLOAT, Op.WRITE_DOUBLE, Op.WRITE_BYTES,
})  # fmt: skip
_TAKE_TWO_GIVE_ONE = frozenset({
    Op.ADD, Op.SUBTRACT, Op.MULTIPLY, Op.CHECKED_ADD, Op.CHECKED_SUBTRACT, Op.CHECKED_MULTIPLY, Op.DIVIDE, Op.MODULO,
    Op.LEAST, Op.GREATEST, Op.REAL_ADD, Op.REAL_SUBTRACT, Op.REAL_MULTIPLY, Op.REAL_DIVIDE, Op.REAL_FLOOR_DIVIDE,
    Op.REAL_MODULO, Op.REAL_POWER, Op.REAL_LEAST, Op.REAL_GREATEST, Op.ATAN2, Op.HYPOT, Op.COMPARE, Op.EITHER, Op.JOIN,
})  # fmt: skip
_TAKE_THREE_GIVE_ONE = frozenset({Op.CLAMP, Op.FIT, Op.WRAP, Op.REAL_CLAMP})


def _effect(operation: Operation) -> int:
    """Return the number of values by which the stack grows."""
    kind = operation.kind
    if kind is Op.LIST:
        return 1 - operation.size
    return (kind in _GIVE) - (kind in _TAKE_ONE or kind in _TAKE_TWO_GIVE_ONE) - 2 * (kind in _TAKE_THREE_GIVE_ONE)


def depths(operations: Sequence[Operation]) -> Iterator[int]:
    """Yield the depth of the stack after each operation."""
    depth = 0
    joins: dict[int, int] = {}  # the depth at the target of a jump
    for index, operation in enumerate(operations):
        depth = joins.pop(index, depth)
        kind, target = operation.kind, index + 1 + operation.size
        before = depth
        depth += _effect(operation)
        if kind is Op.JUMP or kind is Op.UNLESS:
            joins[target] = depth
        elif kind is Op.AND or kind is Op.OR:
            joins[target] = before
        yield depth


def nesting(operations: Iterable[Operation], opens: Op, closes: Op) -> Iterator[int]:
    """Yield the number of open loops, or of messages being written, after each operation."""
    depth = 0
    for operation in operations:
        depth += (operation.kind is opens) - (operation.kind is closes)
        yield depth


_BYTEWISE = frozenset({Op.JOIN, Op.CHARACTERS, Op.STRIP, Op.UTF8, Op.OCTETS, Op.UNPACK, Op.DIGITS})
"""Operations whose time is proportional to a text or list, which is at most as long as a datagram."""

_BYTES_AT_A_TIME = 16


def _flag(operation: Operation) -> Flag | None:
    """Return the flag that an operation loads, if it is the first operation of `once`."""
    return operation.slot if operation.kind is Op.LOAD and isinstance(operation.slot, Flag) else None


def most_executed(operations: Sequence[Operation]) -> int:
    """Return the maximum number of operations for a datagram. A loop has at most MAX_DATAGRAM iterations."""
    total, times = 0, [1]
    flags: dict[int, int] = {}  # how often a flag is cleared
    ends: list[int] = []  # ends of code that is executed once
    previous: Op | None = None
    for index, operation in enumerate(operations):
        while ends and ends[-1] == index:
            ends.pop()
            times.pop()
        cost, slot = 1, operation.slot
        if operation.kind in _BYTEWISE or (operation.kind is Op.ENTER and previous is not Op.NEXT):
            cost += MAX_DATAGRAM // _BYTES_AT_A_TIME
        elif operation.kind is Op.ELEMENT:
            cost += int(operation.number)  # cells are traversed one by one
        total += cost * times[-1]
        if operation.kind is Op.REPEAT:
            times.append(times[-1] * MAX_DATAGRAM)
        elif operation.kind is Op.AGAIN:
            times.pop()
        elif isinstance(slot, Flag) and operation.kind is Op.KEEP:
            flags.setdefault(id(slot), times[-1])
        elif operation.kind is Op.JUMP and (flag := _flag(operations[index - 3])) is not None:
            ends.append(index + 1 + operation.size)
            times.append(flags[id(flag)])
        previous = operation.kind
    return total
